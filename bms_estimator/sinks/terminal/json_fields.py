"""Fields of a payload, each with the requested type: other versions or publishers may send anything. Pure."""

from collections.abc import Iterator

LARGEST = 1e12
"""No number of a battery is larger; longer text would only fill a screen."""
MAX_TEXT = 400
"""Texts are shown so far [characters]."""


class JsonFields:
    """The fields of a JSON object; of anything else none.

    Args:
        payload: As ``published.parsed`` has it.
    """

    def __init__(self, payload: object) -> None:
        self._of = payload if isinstance(payload, dict) else {}

    def __bool__(self) -> bool:
        return bool(self._of)

    def number(self, name: str) -> float | None:
        """Return a number; None if missing."""
        return _number(self._of.get(name))

    def count(self, name: str) -> int:
        """Return an integer; 0 if missing."""
        return int(self.number(name) or 0)

    def text(self, name: str) -> str:
        """Return a text without terminal control characters; empty if missing."""
        return _text(self._of.get(name))

    def flag(self, name: str) -> bool:
        """Return True if the field is true."""
        return self._of.get(name) is True

    def is_null(self, name: str) -> bool:
        """Return True if the field exists and is null."""
        return name in self._of and self._of[name] is None

    def fields(self, name: str) -> "JsonFields":
        """Return an object."""
        return JsonFields(self._of.get(name))

    def texts(self, name: str) -> list[str]:
        """Return a list of texts."""
        return [_text(item) for item in self._list(name) if isinstance(item, str)]

    def numbers(self, name: str) -> list[float | None]:
        """Return a list of numbers, some of which may be missing."""
        return [_number(item) for item in self._list(name)]

    def names(self) -> Iterator[str]:
        """Names of all fields."""
        return (_text(name) for name in self._of)

    def _list(self, name: str) -> list[object]:
        found = self._of.get(name)
        return found if isinstance(found, list) else []


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > LARGEST:
        return None
    return float(value)


def _text(value: object) -> str:
    return "".join(c for c in value[:MAX_TEXT] if c.isprintable()) if isinstance(value, str) else ""
