"""State of a pack at the start of a forecast: that of its checkpoint, or the end of a capture."""

from dataclasses import dataclass
from pathlib import Path

import typer

from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.cli.options.capture_input import capture_file, long_file_bar, print_guesses
from bms_estimator.cli.options.capture_options import MappedColumns, SignOfCurrent
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.pack.pack import new_pack
from bms_estimator.process.state_folder import state_folder
from bms_estimator.settings.pack import Settings
from bms_estimator.sources.captures.replay import open_capture


@dataclass(frozen=True)
class InitialState:
    """Pack at the start of the forecast.

    Attributes:
        name: Name of the pack, or of the capture.
        forecaster: Forecaster with the state of the pack.
        age_s: Time since the state was saved [s]; infinite if unknown; None: the state is the end of a capture.
    """

    name: str
    forecaster: Forecaster
    age_s: float | None


def saved_state(settings: Settings, model: PackModel) -> InitialState:
    """Return the pack with the state of its checkpoint and the observed load saved beside it. No file is changed.

    Raises:
        UserError: There is no valid checkpoint, or no forecast for this pack.
    """
    files = StateFiles(state_folder(settings), settings, model)
    saved = files.saved_pack()
    if saved.pack.forecaster is None:
        raise _no_forecaster(model)
    if saved.load_reason:
        typer.echo(f"warning: {files.load.path}: the observed load is unknown: {saved.load_reason}", err=True)
    return InitialState(settings.pack.name, saved.pack.forecaster, saved.age_s)


def end_of_capture(
    settings: Settings,
    model: PackModel,
    capture: Path,
    current_sign: SignOfCurrent,
    column_map: MappedColumns,
    *,
    has_pack: bool,
) -> InitialState:
    """Return the pack at the end of a capture. The load of the capture is the observed load.

    Raises:
        UserError: The capture cannot be read or has no usable sample, or there is no forecast for this cell.
    """
    with capture_file(capture) as path:
        source = open_capture(
            path, settings.sensor if has_pack else None, current_sign=current_sign, column_map=column_map
        )
        print_guesses(path.name, source)
        pack = new_pack(settings, model, has_forecasts=False)
        if pack.forecaster is None:
            raise _no_forecaster(model)
        slots = CellSlots(model.cell.series_count)
        with long_file_bar("reading", path) as progress:
            for samples in source:
                pack.run(samples, slots.select(source.cells))
                progress(source.fraction)
        if not pack.estimator.state["samples"][0]:
            raise UserError(f"{path}: no usable sample")
    return InitialState(path.name, pack.forecaster, None)


def _no_forecaster(model: PackModel) -> UserError:
    return UserError(f"{model.cell.name}: a forecast needs a battery, and identifier.enabled = true in the settings")
