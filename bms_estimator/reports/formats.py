"""Numbers and durations as text."""

MINUTE_S, HOUR_S, DAY_S = 60.0, 3600.0, 86_400.0
MIN_IN_HOURS_S = 2.0 * HOUR_S
"""Shortest duration that is given in hours [s]."""
MIN_IN_DAYS_S = 2.0 * DAY_S
"""Shortest duration that is given in days [s]."""


def number(value: float, digits: int = 4) -> str:
    """Format a number for tables with significant digits and, if possible, without exponent."""
    if value != value:  # NaN  # noqa: PLR0124
        return "-"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-4 <= abs(value) < 1e9:
        text = f"{value:.{max(digits - 1, 0)}f}" if abs(value) < 1 else f"{value:.0f}"
    return text


def percent(value: float, true: float) -> str:
    """Format the error of ``value`` in percent of the true value (erratum 7)."""
    error = 100.0 * abs(value - true) / abs(true)
    return "0" if error < 1e-4 else number(error, 3)


def duration_text(duration_s: float) -> str:
    """Return a duration in minutes, hours or days."""
    if duration_s < MIN_IN_HOURS_S:
        minutes = round(duration_s / MINUTE_S)
        return f"{minutes} minute{'s' if minutes != 1 else ''}"
    if duration_s < MIN_IN_DAYS_S:
        return f"{duration_s / HOUR_S:.1f} hours"
    return f"{duration_s / DAY_S:.1f} days"
