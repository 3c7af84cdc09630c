"""``[page]``: address and access token of the live page."""

import ipaddress
from pathlib import Path
from typing import Annotated, NamedTuple, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator

from bms_estimator.model.config_file import Strict

DEFAULT_LISTEN = "127.0.0.1:8765"
"""Default address of the page, host:port."""


class ListenAddress(NamedTuple):
    """Address on which a server listens."""

    host: str
    port: int
    """TCP port; 0: any free port."""

    @property
    def loopback(self) -> bool:
        """True if only programs on this machine can connect."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_listen(text: str) -> ListenAddress:
    """Parse ``host:port``.

    Raises:
        ValueError: The text is not a host and a port.
    """
    try:
        url = urlsplit(f"//{text}")
        host, port = url.hostname, url.port
        (host or "").encode("idna")  # the resolver encodes the name this way and would fail later
    except ValueError as error:
        raise ValueError(f"must be host:port: {error}") from None
    if not host or port is None or url.netloc != text or "@" in text:
        raise ValueError('must be host:port, such as "127.0.0.1:8765" or "[::1]:8765"')
    return ListenAddress(host, port)


def _validate_listen(text: str) -> str:
    parse_listen(text)
    return text


Address = Annotated[str, AfterValidator(_validate_listen)]
"""Text ``host:port``."""


class PageSettings(Strict):
    """Live web page of the pack."""

    listen: Address = Field(
        default=DEFAULT_LISTEN,
        description="host:port of the page; packs of one process with the same address share a page. An address that other machines can reach, such as 0.0.0.0:8765, requires token_file",
    )
    token_file: Path | None = Field(
        default=None,
        description="file with the access token; a name without a folder is a systemd credential",
    )
    hosts: tuple[str, ...] = Field(
        default=(), description="further host names under which browsers request the page, for example behind a proxy"
    )

    @property
    def address(self) -> ListenAddress:
        """Host and port of ``listen``."""
        return parse_listen(self.listen)

    @model_validator(mode="after")
    def _require_token_unless_local(self) -> Self:
        if self.token_file is None and not self.address.loopback:
            raise ValueError(
                f'listen = "{self.listen}" is open to other machines: name a token_file, or listen on 127.0.0.1'
            )
        return self
