"""Examples of settings in the documentation of sources: all are valid."""

import re
import tomllib
from pathlib import Path

import pytest

from bms_estimator.settings.pack import Settings
from bms_estimator.settings.sources.mqtt_profiles import PROFILES
from bms_estimator.sources.factory import make_line_producer

DOCS = Path(__file__).parents[2] / "docs" / "pack"
EXAMPLES = [
    (document.name, text)
    for document in sorted([*DOCS.glob("*.md"), *(DOCS.parent / "start").glob("*.md"), DOCS.parents[1] / "README.md"])
    for text in re.findall(r"```toml\n(.*?)```", document.read_text(encoding="utf-8"), flags=re.DOTALL)
]


@pytest.mark.parametrize(("document", "text"), EXAMPLES, ids=lambda value: value[:30])
def test_a_documented_example_is_accepted(
    document: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tables = tomllib.loads(text)
    if password_file := tables.get("mqtt", {}).get("password_file"):
        (tmp_path / password_file).write_text("secret")
    settings = Settings.model_validate(tables)
    # Each example configures a source or a sensor.
    assert settings.model_dump(include={"source"}) or settings.sensor.model_fields_set
    if settings.source is not None and settings.source.kind in ("mqtt", "linux"):
        assert make_line_producer(Settings.model_validate({"mqtt": {}} | tables))


def test_every_mqtt_profile_is_documented() -> None:
    text = (DOCS / "mqtt-source.md").read_text(encoding="utf-8")
    assert [name for name in PROFILES if f"| `{name}` |" not in text] == []
