"""Examples of docs/pack/fieldbus.md: all are valid settings, and the DBC file decodes the frames."""

import re
import tomllib
from pathlib import Path

import pytest

from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.fieldbus import CanSource
from bms_estimator.sources.fieldbus.can_signals import CanDecoder, FrameId

PAGE = (Path(__file__).parents[3] / "docs" / "pack" / "fieldbus.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("example", re.findall(r"^```toml\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL))
def test_example_is_accepted_as_settings(example: str) -> None:
    settings = Settings.model_validate(tomllib.loads(example))
    assert settings.source is not None
    assert settings.sensor.protocol == "text"


def test_example_of_a_dbc_file_has_the_signals_of_the_settings_before_it(tmp_path: Path) -> None:
    match = re.search(
        r"^```toml\n([^`]*?dbc = [^`]*)^```.*?^```text\n(VERSION.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL
    )
    assert match
    path = tmp_path / "pack.dbc"
    path.write_text(match[2])
    table = tomllib.loads(match[1])["source"] | {"dbc": str(path)}
    frames = CanDecoder(CanSource.model_validate(table))
    assert frames.frame_ids == (FrameId(0x6B0, False), FrameId(0x18FF0001, True))
    assert frames.feed(0.0, 0x18FF0001, extended=True, data=bytes.fromhex("e40ce50c")) is None
    reading = frames.feed(0.0, 0x6B0, extended=False, data=bytes.fromhex("ff85020815000000"))
    assert reading is not None
    assert reading[:4] == (52.0, -12.3, (21.0,), (3.3, 3.301))
