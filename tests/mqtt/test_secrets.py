"""Error messages do not show passwords."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from bms_estimator.model.errors import TemporaryError
from bms_estimator.mqtt.connection import check
from bms_estimator.settings.connections import MqttSettings
from tests.command_line import run

SECRET = "s3cret"
URLS_WITH_PASSWORD = [
    f"mqtt://me:{SECRET}@host:1883",
    f"mqtts://me:{SECRET}@host",
    f"mqtt://me:{SECRET}#more@host",
    f"mqtt://me:x/{SECRET}@host",
    f"mqtt://me:x@{SECRET}@host",
    f"http://me:{SECRET}@host",
    f"mqtt://:{SECRET}@host:99999",
    f"mqtt://me:{SECRET} more@host",
    f"mqtt:/me:{SECRET}@host",
    f"mqtt:me:{SECRET}@host",
    f"me:{SECRET}@host:1883",
]


@pytest.mark.parametrize("toml_value", ['"{}"', '["mqtt://host", "{}"]', '["{}", "mqtt://host"]', '["{}", 5]'])
def test_error_on_a_url_hides_the_password(tmp_path: Path, capsys: pytest.CaptureFixture[str], toml_value: str) -> None:
    pack = tmp_path / "pack.toml"
    for url in URLS_WITH_PASSWORD:
        pack.write_text(f"[mqtt]\nurl = {toml_value.format(url)}\n")
        for command in ("check", "show"):
            code, out, err = run(capsys, "config", command, pack)
            assert (code, "mqtt.url" in err, SECRET in out + err) == (2, True, False), url


def test_error_on_a_command_line_url_hides_the_password(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text("[pack]\n")
    for url in URLS_WITH_PASSWORD:
        code, out, err = run(capsys, "run", pack, "--mqtt", url)
        assert (code, "--mqtt" in err, SECRET in out + err) == (2, True, False), url


@pytest.mark.parametrize("url", [*URLS_WITH_PASSWORD, ("mqtt://host", URLS_WITH_PASSWORD[0])])
def test_validation_error_hides_the_password(url: Any) -> None:
    with pytest.raises(ValidationError) as error:
        MqttSettings(url=url)
    assert SECRET not in str(error.value)


def test_error_on_a_non_utf8_password_hides_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "password").write_bytes(SECRET.encode() + b"\xff")
    with pytest.raises(TemporaryError, match=r"mqtt\.password_file = .*: cannot be read: not UTF-8 text$"):
        check(MqttSettings(password_file=tmp_path / "password"))
