"""Addresses of brokers as the settings may have them."""

import re


def of_brokers(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    """Addresses as they must be.

    Raises:
        ValueError: One is none, or holds a name or a password.
    """
    urls = (value,) if isinstance(value, str) else value
    if not urls:
        raise ValueError("must name a broker")
    for url in urls:
        if "@" in url:
            raise ValueError("a name goes to mqtt.username, a password to a file that mqtt.password_file names")
        if not re.fullmatch(r"mqtts?://[^/\s]+", url):
            raise ValueError("must be mqtt://host:port")
    return value
