"""Finding of a check."""

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    WARNING = "warning"
    """Something may become a fault, or could not be checked."""
    FAULT = "fault"
    """The service cannot work as configured."""


@dataclass(frozen=True)
class Finding:
    """Result of a check."""

    check: str
    """Name of the check."""
    level: Level
    text: str
    """Description of the result."""
    remedy: str = ""
    """Instruction, if possible with a command to copy; empty if the level is ok."""


def ok(check: str, text: str) -> Finding:
    """Return a finding without a problem."""
    return Finding(check, Level.OK, text)


def warning(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that may become a fault."""
    return Finding(check, Level.WARNING, text, remedy)


def fault(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that keeps the service from working."""
    return Finding(check, Level.FAULT, text, remedy)
