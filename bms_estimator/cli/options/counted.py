"""Number with its noun, for the output of commands."""


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number with a noun in singular or plural; ``plural`` is the noun with an s by default."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"
