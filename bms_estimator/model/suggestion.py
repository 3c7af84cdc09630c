"""Suggestion of the name that a misspelled name probably stands for."""

from collections.abc import Iterable
from difflib import get_close_matches


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return ``; is X meant?`` for the most similar known name, regardless of case; empty if none is similar."""
    known_by_lower_case = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), known_by_lower_case, n=1)
    return f"; is {known_by_lower_case[close[0]]} meant?" if close else ""
