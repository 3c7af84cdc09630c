"""Time until the learning law and the identifier follow a step of R_s, for docs/theory/observer.md.

From half time on, a real capture has the voltage of a cell whose R_s is half as large again. An estimate has followed the
step once it stays within 10 % of its value on the unchanged capture plus the step, for ten minutes.
"""

import sys

import numpy as np
from rich.console import Console
from rich.table import Table

from bms_estimator.calibration.cleaning.rests import remove_glitches
from bms_estimator.estimator import Estimator
from bms_estimator.kernels.cell_model import chen_mora
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.sample import SampleBlock
from bms_estimator.settings.observer import IdentifierSettings, ObserverSettings
from tests.benchmarks.recipes import DATA, NCR, load

CAPTURES = {"cell5_random_steps": 1.0, "cell1_random_steps": 0.98}
"""SOC at the first sample of each capture."""
LOWEST_SOC = 0.1
"""SOC at which a capture is cut off, because R_s of a real cell rises towards empty."""
STEP = 0.5
"""Step of R_s as a fraction of R_s of the cell file at SOC 0.5."""
INTERVAL_S = 30.0
"""Interval at which R_s is read [s]."""
WITHIN, HOLD_S = 0.1, 600.0
"""Relative deviation within which an estimate must stay, and for how long [s]."""


def main() -> None:
    """Print the time of each method on each capture."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    cell = load_cell("ncr18650")
    table = Table("capture", "learning law [min]", "identifier [min]", title="time to follow a step of R_s by half")
    for name, initial_soc in CAPTURES.items():
        rows, soc = load(NCR + name, cell.cell.capacity_ah, initial_soc)
        samples = remove_glitches(rows[soc > LOWEST_SOC], name)
        minutes = (following_min(cell, samples, initial_soc, learns=learns) for learns in (True, False))
        table.add_row(name, *(f"{each:.1f}" for each in minutes))
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def following_min(cell: CellModel, samples: SampleBlock, initial_soc: float, *, learns: bool) -> float:
    """Return the time from the step until the estimate has followed it [min]; infinite if it never does."""
    step_s = 0.5 * float(samples["time_s"][0] + samples["time_s"][-1])
    step_ohm = STEP * float(chen_mora.r_s(0.5, cell.a))
    changed = samples.copy()
    changed["voltage_v"] -= step_ohm * changed["current_a"] * (changed["time_s"] >= step_s)
    time_s, unchanged_ohm = series_resistance(cell, samples, initial_soc, learns=learns)
    estimated_ohm = series_resistance(cell, changed, initial_soc, learns=learns)[1]
    outside = np.abs(estimated_ohm / (unchanged_ohm + step_ohm) - 1.0) >= WITHIN
    after = time_s >= step_s
    bounds_s = np.concatenate([[step_s], time_s[after & outside], time_s[-1:]])
    lasting = np.flatnonzero(np.diff(bounds_s) >= HOLD_S)
    return float(bounds_s[lasting[0]] - step_s) / 60.0 if lasting.size else np.inf


def series_resistance(
    cell: CellModel, samples: SampleBlock, initial_soc: float, *, learns: bool
) -> tuple[Floats, Floats]:
    """Return times [s] and R_s [ohm]: of the observer with the law ``learning``, otherwise of the identifier."""
    observer, identifier = ObserverSettings(law="learning"), IdentifierSettings()
    estimator = Estimator(cell, observer, identifier=None if learns else identifier, initial_soc=initial_soc)
    time_s = samples["time_s"]
    cuts = np.unique(np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], INTERVAL_S)[1:]))
    rows = []
    for piece in np.split(samples, cuts):
        trace = estimator.run(piece)
        state = estimator.state[0]
        learned_ohm = chen_mora.r_s(float(state["soc"]), state["a"])
        rows.append((piece["time_s"][-1], learned_ohm if learns else trace["r_s_ohm"][-1]))
    times_s, ohm = np.array(rows).T
    return times_s, ohm


if __name__ == "__main__":
    main()
