"""A password in the wrong place is not shown."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.broker_config import check
from bms_estimator.settings.mqtt import MqttSettings
from tests.command_line import run

SECRET = "s3cret"
URLS = [
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


@pytest.mark.parametrize("form", ['"{}"', '["mqtt://host", "{}"]', '["{}", "mqtt://host"]', '["{}", 5]'])
def test_of_a_url_with_a_password_the_error_shows_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    pack = tmp_path / "pack.toml"
    for url in URLS:
        pack.write_text(f"[mqtt]\nurl = {form.format(url)}\n")
        for command in ("check", "show"):
            code, out, err = run(capsys, "config", command, pack)
            assert (code, "mqtt.url" in err, SECRET in out + err) == (2, True, False), url


def test_a_url_on_the_command_line_is_not_repeated_either(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack = tmp_path / "pack.toml"
    pack.write_text("")
    for url in URLS:
        code, out, err = run(capsys, "run", pack, "--mqtt", url)
        assert (code, "--mqtt" in err, SECRET in out + err) == (2, True, False), url


@pytest.mark.parametrize("url", [*URLS, ("mqtt://host", URLS[0])])
def test_the_model_s_own_error_shows_nothing_of_it(url: Any) -> None:
    with pytest.raises(ValidationError) as refused:
        MqttSettings(url=url)
    assert SECRET not in str(refused.value)


def test_of_a_password_that_is_no_text_the_error_shows_no_byte(tmp_path: Path) -> None:
    (tmp_path / "password").write_bytes(SECRET.encode() + b"\xff")
    with pytest.raises(UserError, match=r"mqtt\.password_file = .*: cannot be read: not UTF-8 text$"):
        check(MqttSettings(password_file=tmp_path / "password"))
