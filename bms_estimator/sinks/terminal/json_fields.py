"""Fields of a payload with the requested types, because other versions or publishers may send any value. No I/O."""

MAX_ABS_NUMBER = 1e12
"""Maximum absolute value of an accepted number. No quantity of a battery exceeds it, and longer text would fill a screen."""
MAX_TEXT = 400
"""Maximum length of a text [characters]. Longer texts are truncated."""


class JsonFields:
    """Fields of a JSON object. A payload of another type has no fields.

    Args:
        payload: Parsed JSON, or text.
    """

    def __init__(self, payload: object) -> None:
        self._values = payload if isinstance(payload, dict) else {}

    def __bool__(self) -> bool:
        return bool(self._values)

    def number(self, name: str) -> float | None:
        """Return a number; None if missing."""
        value = self._values.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > MAX_ABS_NUMBER:
            return None
        return float(value)

    def number_text(self, name: str, format_spec: str, factor: float = 1.0) -> str:
        """Return a number times ``factor`` as text; ``-`` if missing."""
        value = self.number(name)
        return "-" if value is None else f"{value * factor:{format_spec}}"

    def count(self, name: str) -> int:
        """Return an integer; 0 if missing."""
        return int(self.number(name) or 0)

    def text(self, name: str) -> str:
        """Return a text without terminal control characters; empty if missing."""
        return _printable(self._values.get(name))

    def texts(self, name: str) -> list[str]:
        """Return a list of texts without terminal control characters; empty if missing."""
        values = self._values.get(name)
        return [_printable(value) for value in values if isinstance(value, str)] if isinstance(values, list) else []

    def flag(self, name: str, *, default: bool = False) -> bool:
        """Return a boolean; ``default`` if missing."""
        value = self._values.get(name)
        return value if isinstance(value, bool) else default


def _printable(value: object) -> str:
    return "".join(c for c in value[:MAX_TEXT] if c.isprintable()) if isinstance(value, str) else ""
