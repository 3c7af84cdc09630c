"""Screen of a calibration beside a pack: instruction, progress, and the voltages of the rests over SOC. No I/O."""

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from bms_estimator.calibration.guided_test.guided_test import GuidedTest, OcvPoint, Phase

CHART_WIDTH, CHART_HEIGHT = 50, 10
"""Size of the chart without its labels [characters]."""
BAR_WIDTH = 40
"""Width of the progress bar [characters]."""


def build_screen(test: GuidedTest, silence_reason: str | None) -> RenderableType:
    """Return the screen.

    Args:
        test: The test in progress.
        silence_reason: Reason why no samples arrive; None while they arrive.
    """
    lines: list[RenderableType] = [Text(test.instruction, style="bold cyan")]
    warnings = (silence_reason, test.restart_reason, test.warning)
    lines += [Text(warning, style="bold yellow") for warning in warnings if warning]
    lines += [
        Text(measured_text(test), style="dim"),
        _progress_line(test),
        Text(remaining_text(test)),
    ]
    if test.points:
        lines += ["", *chart(test.points)]
    return Group(*lines)


def _progress_line(test: GuidedTest) -> Table:
    line = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=1.0, completed=test.progress, width=BAR_WIDTH)
    line.add_row(bar, f"{100.0 * test.progress:.0f} %")
    return line


def instruction_text(test: GuidedTest) -> str:
    """Return the instruction, with the warnings about it."""
    return " ".join(filter(None, (test.restart_reason, test.instruction, test.warning)))


def measured_text(test: GuidedTest) -> str:
    """Return the phase and the measured values."""
    phase = test.phase.value
    if test.phase in (Phase.DISCHARGE, Phase.REST):
        phase += f" {test.discharge_number} of about {test.expected_discharges}"
    now = test.latest
    if now is None:
        return f"{phase}; no sample yet"
    return f"{phase}; {now.voltage_v:.3f} V, {now.current_a:+.2f} A, {test.drawn_ah:z.2f} Ah drawn"


def remaining_text(test: GuidedTest) -> str:
    """Return the remaining time and what it is estimated from."""
    minutes = round(test.remaining_s / 60.0)
    duration = f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
    return f"about {duration} left, {test.remaining_basis}"


def chart(points: Sequence[OcvPoint]) -> list[str]:
    """Return the lines of a chart of voltage over SOC 0..1."""
    low_v, high_v = min(each.voltage_v for each in points), max(each.voltage_v for each in points)
    span_v = max(high_v - low_v, 1e-3)
    grid = [[" "] * CHART_WIDTH for _ in range(CHART_HEIGHT)]
    for each in points:
        column = round(min(max(each.soc, 0.0), 1.0) * (CHART_WIDTH - 1))
        row = round((high_v - each.voltage_v) / span_v * (CHART_HEIGHT - 1))
        grid[row][column] = "•"
    labels = {0: f"{high_v:.3f} V", CHART_HEIGHT - 1: f"{low_v:.3f} V"}
    rows = [f"{labels.get(i, ''):>10} │{''.join(row)}" for i, row in enumerate(grid)]
    axis = f"{'':>10} └{'─' * CHART_WIDTH}"
    return [*rows, axis, f"{'':>11}0 %{'SOC':^{CHART_WIDTH - 7}}100 %"]
