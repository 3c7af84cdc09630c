"""Check of the settings, as in ``config check``."""

from collections.abc import Iterator

from bms_estimator.doctor.finding import Finding, ok, warning
from bms_estimator.doctor.subject import Subject
from bms_estimator.service import pack_check

NAME = "settings"


def check_settings(subject: Subject) -> Iterator[Finding]:
    """Yield a summary of the settings, and each likely mistake.

    Raises:
        UserError: A setting cannot be used.
    """
    warnings = pack_check.check_settings(subject.settings, subject.model)
    yield ok(NAME, f"{subject.path}: {pack_check.summarize(subject.settings, subject.model)}")
    for text in warnings:
        yield warning(NAME, text, f"edit {subject.path}, then: bms-estimator config check {subject.path}")
