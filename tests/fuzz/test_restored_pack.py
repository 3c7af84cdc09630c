"""Restart of a pack from files with implausible values. An exception would end its service at each start."""

import warnings
from concurrent.futures import Future
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, strategies as st

from bms_estimator.checkpoint.arrays_file import HISTORY_SUFFIX, LOAD_SUFFIX
from bms_estimator.checkpoint.state_files import CheckpointFile, StateFiles
from bms_estimator.kernels.accumulators.history import HISTORY_ROW
from bms_estimator.kernels.cells.records import BANK_STATE, CELL as CELL_STATE
from bms_estimator.kernels.records import ESTIMATOR_STATE
from bms_estimator.model.arrays import SAMPLE, fields
from bms_estimator.model.cell import load_cell
from bms_estimator.pack.pack import new_pack
from bms_estimator.pack_model import fit as fit_module, slow_fit as slow_fit_module, solve
from bms_estimator.pack_model.history import ReferenceDischarges, WeakCellTime
from bms_estimator.pack_model.saved import curve_arrays, neutral_fit
from bms_estimator.pack_model.slow_fit import Submit, run_now
from bms_estimator.settings.pack import Settings

SERIES = 4
SETTINGS = Settings.model_validate({"pack": {"cell": "ncr18650", "series": SERIES, "initial_soc": 0.9}})
CELL = load_cell("ncr18650").pack(SERIES, 1)
STEP_S = 10.0
"""Sample period [s]."""
FIT_S = 1800.0
"""Interval between two fits [s]."""
STATE_SUFFIX = ".npz"
"""Suffix of the checkpoint."""
STEM = CheckpointFile(Path(), SETTINGS, CELL).path.stem
"""Stem of the names of all files."""
Arrays = dict[str, np.ndarray]
Files = dict[str, Arrays]
"""Arrays of each file, by its suffix."""
Change = float | str | tuple[int, ...]
"""Number that replaces one or all numbers of an array, or another type or shape of the array."""
CHANGES: tuple[Change, ...] = (
    *(np.nan, np.inf, -np.inf, 1e300, -1e300, 1e18, -1.0, 0.0, 0.5, 17.0, 1e6),
    *("U8", "c16", "f2", "?"),
    *((), (0,), (1,), (3,), (2, 2)),
)
Place = tuple[str, str, str]
"""Suffix of a file, name of an array, and field of a structured array (empty for another array)."""
RECORDS = {
    (STATE_SUFFIX, "state"): ESTIMATOR_STATE,
    (STATE_SUFFIX, "cells.cells"): CELL_STATE,
    (STATE_SUFFIX, "cells.bank"): BANK_STATE,
    (HISTORY_SUFFIX, "rows"): HISTORY_ROW,
    (HISTORY_SUFFIX, "bank_rows"): HISTORY_ROW,
}
"""Types of the structured arrays."""
FIT_FIELDS = tuple(curve_arrays(neutral_fit()))
METADATA = ("capacity_ah", "r_s_ohm", "observer", "token", "wall_s", "synchronised", "boot_s", "boot")
PLACES: tuple[Place, ...] = (
    *((file, name, field) for (file, name), record in RECORDS.items() for field, _ in fields(np.zeros(1, record))),
    *((STATE_SUFFIX, name, "") for name in (*METADATA, *(f"fit.{name}" for name in FIT_FIELDS))),
    *((HISTORY_SUFFIX, name, "") for name in (*FIT_FIELDS, *(f"bank_{name}" for name in FIT_FIELDS))),
    *((HISTORY_SUFFIX, name, "") for name in ("weak_cell_times", "row_elapsed_s", "row_soc", "curves")),
    *((LOAD_SUFFIX, name, "") for name in ("mean_a", "max_a", "filtered_a", "last_a", "rest_s")),
    *((LOAD_SUFFIX, name, "") for name in ("minutes_mean_a", "minutes_max_a", "seen_discharge_a", "seen_charge_a")),
)


def samples_of(hours: float) -> tuple[np.ndarray, np.ndarray]:
    """Return samples of an alternating load, and the voltages of the cells."""
    samples = np.zeros(int(hours * 3600.0 / STEP_S), SAMPLE)
    phase = np.arange(samples.size) % 120
    samples["time_s"] = STEP_S * np.arange(samples.size)
    samples["current_a"] = np.where(phase < 70, 1.5, np.where(phase < 90, 0.0, -1.2))
    drawn = np.cumsum(samples["current_a"]) * STEP_S / 3600.0 / CELL.cell.capacity_ah
    samples["voltage_v"] = SERIES * (4.05 - 0.8 * drawn - 0.03 * samples["current_a"])
    samples["temperature_c"] = 25.0
    return samples, np.repeat(samples["voltage_v"][:, None] / SERIES, SERIES, axis=1)


class Pack:
    """Pack of the service with its files in a folder."""

    def __init__(self, folder: Path, submit: Submit = run_now) -> None:
        self.files = StateFiles(folder, SETTINGS, CELL)
        self.pack = pack = new_pack(SETTINGS, CELL, submit=submit, has_forecasts=False)
        assert pack.slow_fit
        assert pack.cells
        assert pack.forecaster
        self.estimator, self.slow_fit, self.cells, self.forecaster = (
            pack.estimator,
            pack.slow_fit,
            pack.cells,
            pack.forecaster,
        )
        self.files.restore(self.pack)

    def save(self) -> None:
        """Write all files."""
        self.files.save(self.pack.state())

    def run(self, hours: float) -> None:
        """Process samples with cell voltages, without forecasts."""
        self.pack.run(*samples_of(hours))


@pytest.fixture(scope="module", autouse=True)
def quick_fits():
    """Shorten the fits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "STARTS", fit_module.STARTS[:1])
        patch.setattr(solve, "MAX_ITERATIONS", 0)
        patch.setattr(slow_fit_module, "MIN_THROUGHPUT_SOC", 0.0)
        patch.setattr(slow_fit_module, "MIN_INTERVAL_S", FIT_S)
        yield


@pytest.fixture(scope="module")
def seed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of a pack with a fit, first discharges and a weak cell."""
    pack = Pack(tmp_path_factory.mktemp("seed"))
    pack.run(2.0)
    history = pack.slow_fit.history
    history.first_discharges = ReferenceDischarges(history.rows[history.rows["direction"] > 0.0], pack.slow_fit.fit)
    history.weak_cell_times = [WeakCellTime(100.0, 200.0, 0.5), WeakCellTime(1000.0, np.inf, 0.4)]
    pack.save()
    assert pack.slow_fit.fits
    return pack.files.history.path.parent


@cache
def load_files(folder: Path) -> Files:
    """Return the arrays of the files in a folder."""
    return {suffix: dict(np.load(folder / f"{STEM}{suffix}")) for suffix in (STATE_SUFFIX, HISTORY_SUFFIX, LOAD_SUFFIX)}


def test_all_arrays_of_the_files_are_changed(seed: Path) -> None:
    arrays = {(suffix, name) for suffix, content in load_files(seed).items() for name in content}
    assert {place[:2] for place in PLACES} == {each for each in arrays if each[1] not in {"format", "identity"}}


def changed(array: np.ndarray, change: Change, index: int) -> np.ndarray:
    """Return an array with one number, or all if the index is 0, replaced; or with another type or shape."""
    if array.dtype.kind == "U" and not isinstance(change, tuple):
        return np.array(change)
    if isinstance(change, str):
        return array.astype(change)
    if isinstance(change, tuple):
        return np.resize(array, change)
    result = np.array(array)
    with np.errstate(invalid="ignore", over="ignore"):
        result.reshape(-1)[index % array.size if index and array.size else slice(None)] = np.float64(change).astype(
            array.dtype
        )
    return result


def with_change(files: Files, place: Place, change: Change, index: int) -> Files:
    """Return the files with a change at one place."""
    file, name, field = place
    array = files[file][name]
    if field:
        if isinstance(change, str | tuple):
            edited = array[[*array.dtype.names[:-1]]].copy()  # a field is missing
        else:
            edited = array.copy()
            view = dict(fields(edited))[field]
            view[...] = changed(view, change, index)
    else:
        edited = changed(array, change, index)
    return {**files, file: {**files[file], name: edited}}


@example((HISTORY_SUFFIX, "rows", "segment"), 1e300, 0)
@example((HISTORY_SUFFIX, "rows", "soc"), np.nan, 0)
@given(st.sampled_from(PLACES), st.sampled_from(CHANGES), st.integers(0, 1 << 16))
def test_a_pack_with_an_implausible_value_in_one_file_runs_on(
    tmp_path_factory: pytest.TempPathFactory, seed: Path, place: Place, change: Change, index: int
) -> None:
    folder = tmp_path_factory.mktemp("pack")
    for suffix, arrays in with_change(load_files(seed), place, change, index).items():
        np.savez(folder / f"{STEM}{suffix}", **arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of numpy, which ends no service
        pack = Pack(folder, run_now if place[0] == HISTORY_SUFFIX else lambda _: Future())  # other files need no fit
        is_fitted = place[0] == HISTORY_SUFFIX and not list(folder.glob(f"*.refused{HISTORY_SUFFIX}"))
        pack.run(0.6 if is_fitted else 0.03)
        if place[0] == LOAD_SUFFIX:
            pack.forecaster.forecast()
