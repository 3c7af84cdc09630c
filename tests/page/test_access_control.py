"""Access to the page: listen address, token, and host names of requests."""

import pytest

from bms_estimator.model.errors import TemporaryError
from bms_estimator.page.access_control import AccessControl, make_access_control
from bms_estimator.settings.connections import PageSettings, parse_listen

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize(
    ("text", "host", "port", "loopback"),
    [
        ("127.0.0.1:8765", "127.0.0.1", 8765, True),
        ("[::1]:80", "::1", 80, True),
        ("localhost:1", "localhost", 1, True),
        ("0.0.0.0:8765", "0.0.0.0", 8765, False),
        ("pi.local:8765", "pi.local", 8765, False),
    ],
)
def test_listen_address_is_parsed(text, host, port, loopback):
    listen = parse_listen(text)
    assert (listen.host, listen.port, listen.loopback) == (host, port, loopback)


@pytest.mark.parametrize(
    "text", ["", "8765", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:99999", "a@b:1", "a:1/x", "::1:80", "x..y:80"]
)
def test_invalid_address_is_rejected(text):
    with pytest.raises(ValueError, match="host:port"):
        PageSettings(listen=text)


def test_page_for_other_machines_requires_a_token_file():
    with pytest.raises(ValueError, match=r'listen = "0\.0\.0\.0:8765" is open to other machines: name a token_file'):
        PageSettings(listen="0.0.0.0:8765")


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "cannot be read: No such file"), (b"short\n", "has 5 letters, must have 16"), (b"\xff" * 20, "not UTF-8")],
)
def test_invalid_token_is_reported(tmp_path, text, message):
    file = tmp_path / "token"
    if text is not None:
        file.write_bytes(text)
    with pytest.raises(TemporaryError, match=message):
        make_access_control(PageSettings(listen="0.0.0.0:8765", token_file=file))


def test_only_the_token_and_its_cookie_are_accepted_and_a_newline_in_the_file_is_ignored(tmp_path):
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    access = make_access_control(PageSettings(listen="0.0.0.0:8765", token_file=tmp_path / "token"))
    assert access.is_valid_token(TOKEN)
    assert not any(access.is_valid_token(other) for other in ("", TOKEN[:-1], TOKEN + "0", "é" * 16))
    assert not access.is_valid_token("\udcff" * 16)  # aiohttp decodes a header that is not UTF-8 like this
    assert not access.is_valid_cookie("\udcff" * 64)
    assert access.is_valid_cookie(access.cookie)
    assert not access.is_valid_cookie(TOKEN)
    assert TOKEN not in access.cookie


@pytest.mark.parametrize(
    ("host", "accepted"),
    [
        ("127.0.0.1:8765", True),
        ("[::1]:8765", True),
        ("localhost", True),
        ("LOCALHOST:8765", True),
        ("192.168.1.20:8765", True),
        ("bms.example.org", True),
        ("evil.example.org:8765", False),
        ("localhost.evil.example.org", False),
        ("", False),
        ("[", False),
    ],
)
def test_only_ip_addresses_localhost_and_configured_host_names_are_accepted(host, accepted):
    assert AccessControl(["bms.example.org"]).is_own_host(host) is accepted
