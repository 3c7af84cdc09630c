"""A fuel cell's parameters from polarisation curves and records under changing current (thesis 7.3).

Least squares of the voltage, over the ln of all parameters at once, with the kernel that the observer runs. A
parameter that the data determine less well than ``KNOWN`` keeps the value of the file, with a reason.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import get_args

import numpy as np
from scipy.optimize import least_squares

from bms_estimator.kernels.cell_model.fuel_cell import NAMES
from bms_estimator.kernels.cell_model.fuel_cell_open_loop import open_loop, polarisation
from bms_estimator.kernels.observer.learning_records import LEARNABLE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError
from bms_estimator.model.fuel_cell import FuelCellModel, Parameter

KNOWN = 0.3
"""Maximum relative std of a parameter that the data determine."""
WIDEST = math.log(100.0)
"""No parameter is looked for further from the file's value than this factor."""
ROUNDS = 3
"""Number of fits: the weights of the sources follow from the residuals of the fit before."""
MIN_V = 1e-4
"""No source is better than this [V]: what leaves less has as many points as parameters."""
BLOCKS = 20
"""Number of parts of a record whose means show how long its errors are correlated."""
KEYS: tuple[Parameter, ...] = get_args(Parameter)
"""Keys of ``[fuel_cell]``, in the order of ``NAMES``."""
NEEDS = {
    "r_ohm": "steps of the current, or a curve over more of its range",
    "tafel_slope_v": "currents over a decade, the smallest below a tenth of the largest",
    "activation_v": "a settled voltage",
    "c_dl_farad": "steps of the current, sampled faster than the voltage settles",
    "concentration_v": "currents near the limiting one, where the voltage falls off",
    "limiting_current_a": "currents near the limiting one, where the voltage falls off",
    "internal_current_a": "currents near zero",
}
"""Data that a parameter needs."""


@dataclass(frozen=True)
class Source:
    """Voltages that a model is to explain. Arrays have shape (n,).

    Attributes:
        name: For people.
        time_s: Increasing [s]; None: a polarisation curve, where each point has settled.
        current_a: Positive when the stack delivers [A].
        voltage_v: Voltage of the stack [V].
        temperature_c: NaN without a sensor [C].
    """

    name: str
    time_s: Floats | None
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats

    def predicted(self, file: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Voltage [V] and its derivatives by theta, shape (n, 8)."""
        if self.time_s is None:
            return polarisation(file, theta, self.current_a, self.temperature_c)
        return open_loop(file, theta, self.time_s, self.current_a, self.temperature_c)


@dataclass(frozen=True)
class FuelCellFit:
    """Result of the fit.

    Attributes:
        model: The stack with its parameters, and their errors in ``std``.
        rms_v: Residual voltage by the name of each source, RMS [V].
        not_told: Reason why a parameter kept the value of the file, by its key in ``[fuel_cell]``.
    """

    model: FuelCellModel
    rms_v: dict[str, float]
    not_told: dict[Parameter, str]


def fit_fuel_cell(sources: Sequence[Source], start: FuelCellModel) -> FuelCellFit:
    """Identify a stack.

    Args:
        sources: Curves and records.
        start: Start of the search, and values of parameters that the data do not determine.

    Raises:
        UserError: The data determine no parameter.
    """
    file, told, not_told = start.a, list(range(len(NAMES))), dict[Parameter, str]()
    while told:
        theta, covariance = _fit(sources, file, told)
        std = np.sqrt(np.diagonal(covariance))
        worst = int(np.argmax(std))
        if std[worst] <= KNOWN:
            break
        j = told.pop(worst)
        known = f"to {std[worst]:.0%} at best" if std[worst] < 1.0 else "at all"
        not_told[KEYS[j]] = f"not known {known} from these data; it needs {NEEDS[NAMES[j]]}"
    if not told:
        reasons = "; ".join(f"{key}: it needs {NEEDS[name]}" for key, name in zip(KEYS, NAMES, strict=True))
        raise UserError(f"these data tell of no parameter of a fuel cell: {reasons}")
    a = file.copy()
    a[1 : 1 + len(NAMES)] *= np.exp(theta[: len(NAMES)])
    rms_v = {source.name: _rms(source.voltage_v - source.predicted(file, theta)[0]) for source in sources}
    return FuelCellFit(start.identified(a, _errors(a, told, covariance)), rms_v, not_told)


def _fit(sources: Sequence[Source], file: Floats, told: list[int]) -> tuple[Floats, Floats]:
    """Fit theta, shape (8,); return it with the covariance of the determined parameters."""
    theta, weights = np.zeros(LEARNABLE), np.ones(len(sources))

    def all_of(values: Floats) -> Floats:
        full = np.zeros(LEARNABLE)
        full[told] = values
        return full

    @lru_cache(maxsize=2)
    def predicted(values: bytes) -> list[tuple[Floats, Floats]]:
        return [source.predicted(file, all_of(np.frombuffer(values))) for source in sources]

    def residual(values: Floats) -> Floats:
        pairs = zip(weights, sources, predicted(values.tobytes()), strict=True)
        return np.concatenate([w * (source.voltage_v - voltage_v) for w, source, (voltage_v, _) in pairs])

    def jacobian(values: Floats) -> Floats:
        pairs = zip(weights, predicted(values.tobytes()), strict=True)
        return np.concatenate([-w * psi[:, told] for w, (_, psi) in pairs])

    for _ in range(ROUNDS):
        found = least_squares(residual, theta[told], jacobian, bounds=(-WIDEST, WIDEST), x_scale=0.1)
        theta = all_of(found.x)
        weights = np.array([_weight(source, file, theta, len(told)) for source in sources])
    information = jacobian(theta[told])
    return theta, np.linalg.pinv(information.T @ information, hermitian=True) + _blind(information)


def _blind(jacobian: Floats) -> Floats:
    """Unbounded variance in directions that no datum determines; a pseudoinverse alone gives zero."""
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    unseen: Floats = vectors[:, values <= 1e-10 * values.max()]
    blind: Floats = 1e6 * unseen @ unseen.T
    return blind


def _weight(source: Source, file: Floats, theta: Floats, parameters: int) -> float:
    """One over the error of a voltage that counts once: errors that are alike for a while count as one."""
    error_v = source.voltage_v - source.predicted(file, theta)[0]
    free = max(error_v.size - parameters, 1) / error_v.size
    rms_v = max(_rms(error_v) / math.sqrt(free), MIN_V)
    return 1.0 / (rms_v * math.sqrt(_alike(error_v) if source.time_s is not None else 1.0))


def _alike(error_v: Floats) -> float:
    """Return the number of successive samples that count as one: variance of block means over that of independent samples."""
    size = error_v.size // BLOCKS
    if size < 2:
        return 1.0
    means = error_v[: size * BLOCKS].reshape(BLOCKS, size).mean(axis=1)
    return float(np.clip(size * (means**2).mean() / max((error_v**2).mean(), MIN_V**2), 1.0, size))


def _errors(a: Floats, told: list[int], covariance: Floats) -> dict[Parameter, float]:
    """Relative standard deviations by key; that of the exchange current e^(-a / A) from those of a and A."""
    std = {KEYS[j]: math.sqrt(covariance[k, k]) for k, j in enumerate(told)}
    slope, activation = NAMES.index("tafel_slope_v"), NAMES.index("activation_v")
    ratio = a[1 + activation] / a[1 + slope]  # - ln i_0; d ln i_0 = ratio (d ln A - d ln a)
    along = np.array([ratio if j == slope else -ratio if j == activation else 0.0 for j in told])
    if "exchange_current_a" in std:
        std["exchange_current_a"] = math.sqrt(along @ covariance @ along)
    return std


def _rms(error_v: Floats) -> float:
    return float(np.sqrt((error_v**2).mean()))
