"""The examples of docs/pack/fieldbus.md are settings."""

import re
import tomllib
from pathlib import Path

import pytest

from bms_estimator.settings.pack import Settings

TEXT = (Path(__file__).parents[3] / "docs" / "pack" / "fieldbus.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("example", re.findall(r"^```toml\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL))
def test_an_example_is_accepted(example: str) -> None:
    settings = Settings.model_validate(tomllib.loads(example))
    assert settings.source is not None
    assert settings.sensor.protocol == "text"
