"""``bms-estimator accuracy``: how accurately the SOC of a pack can be estimated in its use, and which change helps most."""

import json
import math
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.options.capture_options import CELL_HELP, AsJson, CapacityAh, complete_battery
from bms_estimator.cli.options.pack_options import pack_or_cell
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.cli.options.table import print_table
from bms_estimator.estimator.estimator import make_estimator
from bms_estimator.kernels.kalman_filter.anchors import FULL
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack_model.accuracy import MIN_WINDOW, Accuracy, Window, improvements, window_of_history
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.history import History
from bms_estimator.process.state_folder import state_folder
from bms_estimator.settings.pack import Settings


@dataclass(frozen=True)
class AccuracyResult:
    """Output of ``--json``. SOCs and stds are fractions."""

    low: float
    high: float
    full_charges: int | None
    """Number of full charges in the history; None without a history."""
    has_temperature: bool
    best_std: float
    """Lower bound of the std of the SOC, mean over the window."""
    best_capacity_std: float
    """Lower bound of the relative std of the capacity."""
    present_std: float | None
    """Std of the SOC in the last checkpoint; None without a pack."""
    with_change: dict[str, float]
    """Lower bound of the std of the SOC after each change, the lowest first."""


def accuracy(
    pack: Annotated[
        Path | None,
        typer.Option(
            help="settings file of the pack; its history shows in which range and with how many full charges it is used",
            show_default=False,
        ),
    ] = None,
    cell: Annotated[
        str | None, typer.Option(help=CELL_HELP, autocompletion=complete_battery, show_default=False)
    ] = None,
    capacity_ah: CapacityAh = None,
    between: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="range of SOC in which the pack is used [%]; HIGH = 100 means with full charges; default: the range in the history",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute how accurately the SOC of a pack can be estimated, and which change of its use or equipment helps most.

    The result is a lower bound. No estimator that knows only the cell file has a smaller RMS error, however long it runs,
    averaged over the cells that the file describes.
    With --cell, a pack without a temperature sensor is assumed.
    """
    if pack is None and between is None:
        raise UserError("give --pack pack.toml, or --cell NAME with --between LOW HIGH")
    settings, model = pack_or_cell(pack, cell, capacity_ah)
    model.battery(f"{model.cell.name}: a fuel cell has no SOC")
    window, present_std, full_charges = Window(0.0, has_temperature=False), None, None
    if pack is not None:
        compile_ahead()
        window, present_std, full_charges = _window_of_pack(settings, model)
    if between is not None:
        window = _with_ends(window, *between)
    elif window.high - window.low < MIN_WINDOW:
        raise UserError(
            f"{pack}: the history has a use from {window.low:.0%} to {window.high:.0%} only; give --between LOW HIGH"
        )
    curves = CellCurves(make_estimator(settings, model).cell_file_settings)
    best = Accuracy(curves, window)
    result = AccuracyResult(
        float(window.soc[0]), float(window.soc[-1]), full_charges, window.has_temperature,
        best.mean_std, best.capacity_std, present_std, improvements(curves, window),
    )  # fmt: skip
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        _print(result)


def _with_ends(window: Window, low: float, high: float) -> Window:
    """Return a window with other ends [%]. A window up to 100 % has full charges."""
    if not (low >= 0.0 and high <= 100.0 and high - low >= 100.0 * MIN_WINDOW):
        raise UserError(
            f"--between {low:g} {high:g}: give two SOCs from 0 to 100 with a distance of at least {MIN_WINDOW:.0%}"
        )
    return replace(window, low=low / 100.0, high=high / 100.0, full=high == 100.0, charge_seen=True)


def _window_of_pack(settings: Settings, model: PackModel) -> tuple[Window, float, int]:
    """Return the window of a pack's history, the std of its SOC, and its number of full charges.

    Without a history the window is empty.

    Raises:
        UserError: There is no checkpoint.
    """
    saved = StateFiles(state_folder(settings), settings, model).saved_pack().pack
    history, fit = (saved.slow_fit.history, saved.slow_fit.saved_fit) if saved.slow_fit else (History(), None)
    window = window_of_history(history.rows, fit, has_temperature=bool(saved.estimator.record[0]["filter"]["sensed"]))
    return window, saved.estimator.weakest_cell_soc_std, int((history.rows["reference_kind"] == FULL).sum())


def _print(result: AccuracyResult) -> None:
    full = "" if result.full_charges is None else f", {result.full_charges} full charges"
    sensor = "" if result.has_temperature else ", no temperature sensor"
    typer.echo(f"SOC {result.low:.0%} to {result.high:.0%}{full}{sensor}")
    rows = [("smallest possible std", result.best_std)]
    if result.present_std is not None and math.isfinite(result.present_std):
        rows.append(("std today", result.present_std))
    rows += [(f"smallest possible std with {name}", std) for name, std in result.with_change.items()]
    print_table(["", "SOC"], [(name, f"{100.0 * std:.1f} %") for name, std in rows])
    best = next(iter(result.with_change), None)
    if best is not None and result.with_change[best] < result.best_std:
        is_lowest = result.with_change[best] == min(result.with_change.values())
        typer.echo(
            f"{best[0].upper()}{best[1:]} {'helps most' if is_lowest else 'helps about as much as the best change, and costs nothing'}."
        )
