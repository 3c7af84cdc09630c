"""Identified parameters in the estimator's records, with their standard deviations.

Two fits contribute: the fit of each element to the identifier's map over SOC (``record["fit"]``), and the slow fit to weeks of
history, which replaces the curves of the cell file in ``settings["filter"]``. A resistance is the sum of two curves over SOC at
25 C: ``weak_ohm`` depends weakly on the temperature, ``strong_ohm`` strongly.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.estimator.filter_settings import SOC_GRID
from bms_estimator.kernels.cell_model.chen_mora import emf
from bms_estimator.kernels.cell_model.rc_ladder import on_grid
from bms_estimator.kernels.identifier import MIN_BINS
from bms_estimator.kernels.kalman_filter.element_map import ELEMENT_NAMES
from bms_estimator.kernels.kalman_filter.equivalent_circuit import C_TL, C_TS, R_S, R_TL, R_TS, ln_r_s_ratio
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION, node_error_scale, node_position
from bms_estimator.kernels.kalman_filter.records import EKF_SETTINGS, LN_Q, LN_R, LN_R0, NODE, NODES, OFFSET
from bms_estimator.model.arrays import Floats, exp
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_sections import TableOcv

MAX_CAPACITY_STD = 0.3
"""Maximum relative std of the capacity that a cell file may contain."""
EVEN_SOC = tuple(np.round(np.linspace(0.0, 1.0, 101), 2).tolist())
"""SOC nodes of an OCV table that is computed from the function (2.10) of the thesis."""
MIN_RISE_V = 1e-6
"""Minimum rise of the OCV between two SOCs of its table [V]."""


class IdentifiedValue(NamedTuple):
    """Value and standard deviation, both in the unit of the value's name, and age of the last data that determined them."""

    value: float
    std: float
    age_s: float

    @property
    def relative_std(self) -> float:
        """Relative standard deviation; infinite if unknown."""
        return self.std / abs(self.value) if math.isfinite(self.std) and self.value else math.inf


def present_elements(record: np.void) -> dict[str, IdentifiedValue]:
    """Return the elements at the present SOC by name (``ELEMENT_NAMES``), in ohm and farad.

    Args:
        record: Record of dtype ESTIMATOR_STATE, after a sample, with the identifier enabled.
    """
    elements, ages_s = record["elements"], record["unlearned_s"]
    indices = [R_TS, R_TL, C_TS, C_TL, R_S]  # in the order of ELEMENT_NAMES
    values = elements["value"][indices]
    stds = values * np.sqrt(elements["ln_variance"][indices])
    return {
        name: IdentifiedValue(float(value), float(std), float(age_s))
        for name, value, std, age_s in zip(ELEMENT_NAMES, values, stds, ages_s, strict=True)
    }


def fitted_parameter(record: np.void, index: int) -> IdentifiedValue | None:
    """Return a_i of the fit to the map over SOC; None if its element was observed in fewer than ``MIN_BINS`` SOC bins.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
        index: i, 1..15.
    """
    element = (index - 1) // 3
    fit = record["fit"]
    if fit["bins"][element] < MIN_BINS:
        return None
    return IdentifiedValue(float(fit["a"][index]), float(fit["std"][index]), float(record["unlearned_s"][element]))


def relative_capacity(record: np.void) -> IdentifiedValue:
    """Return the ratio of the estimated to the declared capacity."""
    ln_q, std = _state_and_std(record, LN_Q)
    return IdentifiedValue(math.exp(ln_q), math.exp(ln_q) * std, 0.0)


def relative_series_resistance(record: np.void, settings: np.void, cell_file: np.void | None = None) -> IdentifiedValue:
    """Return the ratio of R_s to that of the cell file at equal SOC and temperature.

    Args:
        record: Record of dtype ESTIMATOR_STATE, after a sample, with the identifier enabled.
        settings: Record of dtype ESTIMATOR_SETTINGS.
        cell_file: ``Estimator.cell_file_settings``; None: ``settings`` has the curves of the cell file.
    """
    f, p = record["filter"], settings["filter"]
    ln_ratio, variance = ln_r_s_ratio(f, p)
    value = math.exp(ln_ratio)
    if cell_file is not None:
        value *= _series_ohm(f, p) / _series_ohm(f, cell_file)
    return IdentifiedValue(
        value, value * math.sqrt(variance), float(record["unlearned_s"][ELEMENT_NAMES.index("r_s_ohm")])
    )


def _series_ohm(f: np.void, p: np.void) -> float:
    """Return R_0 of the curves in ``p`` at the present SOC and temperature [ohm]."""
    soc = float(f["soc"])
    weak_ohm, strong_ohm = (on_grid(soc, np.ascontiguousarray(p[name][:, 0])) for name in ("weak_ohm", "strong_ohm"))
    return float(f["weak"] * weak_ohm + f["strong"] * strong_ohm)


def fitted_ocv_correction(estimator: Estimator, soc: Floats) -> Floats:
    """Return the correction of the cell file's OCV by the slow fit [V]. The filter's own correction is not included."""
    p, cell_file = estimator.settings_record[0]["filter"], estimator.cell_file_settings
    difference_v: Floats = p["ocv_v"] - cell_file["ocv_v"]
    return np.asarray(np.interp(soc, np.linspace(0.0, 1.0, difference_v.size), difference_v))


def fitted_resistance_factors(estimator: Estimator, soc: Floats) -> Floats:
    """Return the slow fit's factors on the resistances R_0..R_6 of the cell file, shape (n, RESISTANCES)."""
    p, cell_file = estimator.settings_record[0]["filter"], estimator.cell_file_settings
    fitted_ohm, file_ohm = (record["weak_ohm"] + record["strong_ohm"] for record in (p, cell_file))
    factors = np.divide(fitted_ohm, file_ohm, out=np.ones_like(file_ohm), where=file_ohm > 0.0)
    return np.column_stack([np.interp(soc, SOC_GRID, column) for column in factors.T])


def current_offset(record: np.void) -> IdentifiedValue:
    """Return the offset of the current sensor: measured less true current [A]."""
    return IdentifiedValue(*_state_and_std(record, OFFSET), 0.0)


def _state_and_std(record: np.void, j: int) -> tuple[float, float]:
    """Return the mean and standard deviation of state ``j`` over the mixture of hypotheses."""
    f = record["filter"]
    n = f["count"]
    if n == 1:  # the usual case, which is cheaper
        return float(f["mean"][0, j]), math.sqrt(f["covariance"][0, j, j])
    weight = exp(f["ln_weight"][:n] - f["ln_weight"][f["best"]])
    weight /= weight.sum()
    values, variances = f["mean"][:n, j], f["covariance"][:n, j, j]
    mean = float(weight @ values)
    return mean, math.sqrt(weight @ (variances + (values - mean) ** 2))


def ocv_correction_with_std(record: np.void, settings: np.void, soc: Floats) -> tuple[Floats, Floats]:
    """Return the OCV correction learned by the most likely hypothesis, and its standard deviation.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
        settings: Record of dtype ESTIMATOR_SETTINGS.
        soc: Shape (n,), 0..1.

    Returns:
        Two arrays of shape (n,) [V]: the correction, and the standard deviation of the corrected curve.
    """
    f, p = record["filter"], settings["filter"]
    mean, covariance = f["mean"][f["best"]], f["covariance"][f["best"]][NODE:, NODE:]
    weights_v, varying_error_v = _node_weights(p.tobytes(), soc.tobytes())
    variance_v2 = ((weights_v @ covariance) * weights_v).sum(axis=1) + varying_error_v**2
    return weights_v @ mean[NODE:], np.sqrt(variance_v2)


@lru_cache(maxsize=64)
def _node_weights(settings: bytes, socs: bytes) -> tuple[Floats, Floats]:
    """Return the weight of each node of the correction, and the std of the error that no node covers, at each SOC [V].

    Args:
        settings: Bytes of a record of EKF_SETTINGS, a hashable argument for the cache.
        socs: Bytes of an array of SOCs, float64.
    """
    p, soc = np.frombuffer(bytearray(settings), EKF_SETTINGS)[0], np.frombuffer(socs)
    weights_v, varying_error_v = np.zeros((soc.size, NODES)), np.zeros(soc.size)
    for n, x in enumerate(soc):
        i, t = node_position(x)
        scale_v = node_error_scale(p, x, t)
        weights_v[n, i], weights_v[n, i + 1] = scale_v * (1.0 - t), scale_v * t
        varying_error_v[n] = on_grid(x, p["varying_error_v"])
    return weights_v, varying_error_v


def identified_cell(estimator: Estimator, cell: CellModel, series: int) -> CellModel:
    """Return the cell file with the learned OCV, capacity and resistances and their errors.

    Args:
        estimator: Estimator of a pack of that cell, after samples, with the identifier enabled.
        cell: Single cell of the cell file, before ``CellModel.pack``.
        series: Number of these cells in series in the pack.
    """
    record, settings = estimator.record[0], estimator.settings_record[0]
    capacity = relative_capacity(record)
    ln_r0, ln_r, r_std = _resistance_scales(estimator)
    # the elements of a cell file have one factor for all SOCs: R_0 by its own, each RC pair by the usual one of R_1..R_6
    fitted = fitted_resistance_factors(estimator, np.array([0.5]))[0]
    r0_factor, pair_factor = math.exp(ln_r0) * fitted[0], math.exp(ln_r) * float(np.median(fitted[1:]))
    values = cell.model_dump()
    values["cell"]["capacity_ah"] *= capacity.value
    values["cell"]["capacity_std"] = min(capacity.relative_std, MAX_CAPACITY_STD)
    for name, factor in (("r_s", r0_factor), ("r_ts", pair_factor), ("r_tl", pair_factor)):
        values[name] |= {key: factor * values[name][key] for key in ("amplitude_ohm", "offset_ohm")}
    for name in ("c_ts", "c_tl"):  # the time constants do not change
        values[name] |= {key: values[name][key] / pair_factor for key in ("amplitude_farad", "offset_farad")}
    if cell.ladder is not None:
        scales = np.exp(np.array([ln_r0, *(len(cell.ladder.weak_ohm) - 1) * [ln_r]]))
        factors = scales[:, None] * fitted_resistance_factors(estimator, np.array(cell.ladder.soc)).T
        for name in ("weak_ohm", "strong_ohm"):
            values["ladder"][name] = (factors * np.array(values["ladder"][name])).tolist()
        values["ladder"]["std"] = r_std
    # false for a curve with a plateau before a slow fit: its nodes then have one common error, and the curve keeps its shape
    if settings["filter"]["node_correlation"] <= NODE_CORRELATION:
        values["ocv"] = _corrected_ocv(estimator, cell, series)
    return CellModel.model_validate(values)


def _resistance_scales(estimator: Estimator) -> tuple[float, float, float]:
    """Return ln of the factors on R_0 and on the RC pairs of the filter's curves, and the relative std of the resistances.

    The curves of a slow fit already contain the pack's resistances over weeks. The filter's factors on these curves follow the
    load of the last hours. They are not used.
    """
    p = estimator.settings_record[0]["filter"]
    if not np.array_equal(p["weak_ohm"], estimator.cell_file_settings["weak_ohm"]):  # the curves of a slow fit
        return 0.0, 0.0, float(p["r_std"])
    record = estimator.record[0]
    (ln_r0, r0_std), (ln_r, r_std) = _state_and_std(record, LN_R0), _state_and_std(record, LN_R)
    return ln_r0, ln_r, max(r0_std, r_std)


def _corrected_ocv(estimator: Estimator, cell: CellModel, series: int) -> dict[str, Any]:
    """Return the section ``ocv`` of a cell file with the corrected OCV, its std, and the fitted hysteresis."""
    table = cell.ocv.model_dump() if isinstance(cell.ocv, TableOcv) else {"form": "table", "soc": EVEN_SOC}
    soc = np.array(table["soc"])
    correction_v, std_v = ocv_correction_with_std(estimator.record[0], estimator.settings_record[0], soc)
    correction_v = correction_v + fitted_ocv_correction(estimator, soc)
    ocv_v = np.array(table["ocv_v"]) if "ocv_v" in table else np.array([emf(x, cell.a) for x in soc])
    rising_v = np.maximum.accumulate(ocv_v + correction_v / series) + MIN_RISE_V * np.arange(soc.size)
    if table.get("hysteresis_v"):
        factor = _fitted_hysteresis_factor(estimator)
        table = table | {"hysteresis_v": [factor * v for v in table["hysteresis_v"]]}
    return table | {"ocv_v": rising_v.tolist(), "error_v": (std_v / series).tolist()}


def _fitted_hysteresis_factor(estimator: Estimator) -> float:
    """Return the slow fit's factor on the hysteresis of the cell file."""
    fitted_v, file_v = (
        estimator.settings_record[0]["filter"]["hysteresis_v"],
        estimator.cell_file_settings["hysteresis_v"],
    )
    return float(fitted_v.sum() / file_v.sum()) if file_v.any() else 1.0
