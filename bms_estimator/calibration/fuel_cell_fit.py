"""Identification of a fuel cell from polarization curves and records under changing current, section 7.3 of the thesis.

The voltage is fitted by least squares with the kernel that the observer runs. The unknowns theta are the logarithms of
the parameters relative to their initial values. A parameter with a relative std above ``MAX_RELATIVE_STD`` is not
changed, and the result states the reason.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import get_args

import numpy as np
from scipy.optimize import least_squares

from bms_estimator.kernels.cell_model.fuel_cell import NAMES, open_loop, polarisation
from bms_estimator.kernels.observer.records import LEARNABLE
from bms_estimator.model.arrays import Floats
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import FuelCellModel, Parameter

MAX_RELATIVE_STD = 0.3
"""Maximum relative std of a parameter that the data determine."""
MAX_LN_CHANGE = math.log(100.0)
"""Maximum magnitude of theta, the ln of the ratio between a parameter and its initial value."""
FIT_PASSES = 3
"""Number of successive fits. The residuals of each fit give the weights of the sources in the next."""
MIN_STD_V = 1e-4
"""Minimum std of a source [V]. A smaller residual means that a source has hardly more points than parameters."""
BLOCKS = 20
"""Number of blocks of a record whose means give the correlation length of its errors."""
KEYS: tuple[Parameter, ...] = get_args(Parameter)
"""Keys of ``[fuel_cell]``, in the order of ``NAMES``."""
REQUIRED_DATA = {
    "r_ohm": "steps of the current, or a curve over more of its range",
    "tafel_slope_v": "currents over a decade, the smallest below a tenth of the largest",
    "activation_v": "a settled voltage",
    "c_dl_farad": "steps of the current, sampled faster than the voltage settles",
    "concentration_v": "currents near the limiting one, where the voltage falls off",
    "limiting_current_a": "currents near the limiting one, where the voltage falls off",
    "internal_current_a": "currents near zero",
}
"""Data that determine each parameter, for messages."""


@dataclass(frozen=True)
class Source:
    """Measured voltages of a polarization curve or a record. Arrays have shape (n,).

    Attributes:
        name: Name for messages.
        time_s: Increasing times [s]; None: a polarization curve of steady-state points.
        current_a: Current [A], positive when the stack delivers power.
        voltage_v: Voltage of the stack [V].
        temperature_c: Temperature [C]; NaN without a sensor.
    """

    name: str
    time_s: Floats | None
    current_a: Floats
    voltage_v: Floats
    temperature_c: Floats

    def predict(self, initial_parameters: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the model's voltage [V] and its derivatives by theta, shape (n, LEARNABLE)."""
        if self.time_s is None:
            return polarisation(initial_parameters, theta, self.current_a, self.temperature_c)
        return open_loop(initial_parameters, theta, self.time_s, self.current_a, self.temperature_c)


@dataclass(frozen=True)
class FuelCellFit:
    """Result of the fit.

    Attributes:
        model: The stack with its parameters, and their errors in ``std``.
        rms_v: RMS residual voltage of each source, by name [V].
        undetermined: Reason why a parameter keeps its initial value, by its key in ``[fuel_cell]``.
    """

    model: FuelCellModel
    rms_v: dict[str, float]
    undetermined: dict[Parameter, str]


def fit_fuel_cell(sources: Sequence[Source], start: FuelCellModel) -> FuelCellFit:
    """Identify the parameters of a stack.

    Args:
        sources: Polarization curves and records.
        start: Initial values. A parameter that the data do not determine has its initial value in the result.

    Raises:
        UserError: The data determine no parameter.
    """
    initial_parameters, free, undetermined = start.a, list(range(len(NAMES))), dict[Parameter, str]()
    while free:
        theta, covariance = _fit(sources, initial_parameters, free)
        std = np.sqrt(np.diagonal(covariance))
        worst = int(np.argmax(std))
        if std[worst] <= MAX_RELATIVE_STD:
            break
        parameter = free.pop(worst)
        accuracy = f"only to {std[worst]:.0%}" if std[worst] < 1.0 else "not"
        undetermined[KEYS[parameter]] = (
            f"{accuracy} determined by these data; it needs {REQUIRED_DATA[NAMES[parameter]]}"
        )
    if not free:
        reasons = "; ".join(f"{key}: it needs {REQUIRED_DATA[name]}" for key, name in zip(KEYS, NAMES, strict=True))
        raise UserError(f"these data determine no parameter of a fuel cell: {reasons}")
    a = initial_parameters.copy()
    a[1 : 1 + len(NAMES)] *= np.exp(theta[: len(NAMES)])
    rms_v = {source.name: _rms(source.voltage_v - source.predict(initial_parameters, theta)[0]) for source in sources}
    return FuelCellFit(start.identified(a, _errors(a, free, covariance)), rms_v, undetermined)


def _fit(sources: Sequence[Source], initial_parameters: Floats, free: list[int]) -> tuple[Floats, Floats]:
    """Fit the parameters with the indices ``free``; return theta, shape (LEARNABLE,), and their covariance."""
    theta, weights = np.zeros(LEARNABLE), np.ones(len(sources))

    def full_theta(values: Floats) -> Floats:
        full = np.zeros(LEARNABLE)
        full[free] = values
        return full

    @lru_cache(maxsize=2)  # residual and jacobian are called with equal values
    def predictions(values: bytes) -> list[tuple[Floats, Floats]]:
        return [source.predict(initial_parameters, full_theta(np.frombuffer(values))) for source in sources]

    def residual(values: Floats) -> Floats:
        pairs = zip(weights, sources, predictions(values.tobytes()), strict=True)
        return np.concatenate([weight * (source.voltage_v - voltage_v) for weight, source, (voltage_v, _) in pairs])

    def jacobian(values: Floats) -> Floats:
        pairs = zip(weights, predictions(values.tobytes()), strict=True)
        return np.concatenate([-weight * derivatives[:, free] for weight, (_, derivatives) in pairs])

    for _ in range(FIT_PASSES):
        solution = least_squares(residual, theta[free], jacobian, bounds=(-MAX_LN_CHANGE, MAX_LN_CHANGE), x_scale=0.1)
        theta = full_theta(solution.x)
        weights = np.array([_weight(source, initial_parameters, theta, len(free)) for source in sources])
    weighted_jacobian = jacobian(theta[free])
    information = weighted_jacobian.T @ weighted_jacobian
    return theta, np.linalg.pinv(information, hermitian=True) + _null_space_variance(information)


def _null_space_variance(information: Floats) -> Floats:
    """Return a very large variance in directions that no datum determines, where a pseudoinverse gives zero."""
    values, vectors = np.linalg.eigh(information)
    null_space: Floats = vectors[:, values <= 1e-10 * values.max()]
    variance: Floats = 1e6 * null_space @ null_space.T
    return variance


def _weight(source: Source, initial_parameters: Floats, theta: Floats, parameters: int) -> float:
    """Return the inverse std of a source's voltage, reduced for correlated errors of successive samples."""
    error_v = source.voltage_v - source.predict(initial_parameters, theta)[0]
    freedom = max(error_v.size - parameters, 1) / error_v.size
    rms_v = max(_rms(error_v) / math.sqrt(freedom), MIN_STD_V)
    return 1.0 / (rms_v * math.sqrt(_correlation_length(error_v) if source.time_s is not None else 1.0))


def _correlation_length(error_v: Floats) -> float:
    """Return the number of successive samples that count as one.

    The number is the variance of block means over its value for independent samples.
    """
    size = error_v.size // BLOCKS
    if size < 2:
        return 1.0
    means = error_v[: size * BLOCKS].reshape(BLOCKS, size).mean(axis=1)
    return float(np.clip(size * (means**2).mean() / max((error_v**2).mean(), MIN_STD_V**2), 1.0, size))


def _errors(a: Floats, free: list[int], covariance: Floats) -> dict[Parameter, float]:
    """Return the relative standard deviations by key.

    The standard deviation of the exchange current i_0 = e^(-a / A) follows from the covariance of a and A.
    """
    std = {KEYS[j]: math.sqrt(covariance[k, k]) for k, j in enumerate(free)}
    slope, activation = NAMES.index("tafel_slope_v"), NAMES.index("activation_v")
    # ln i_0 = -ratio, therefore d ln i_0 = ratio (d ln A - d ln a)
    ratio = a[1 + activation] / a[1 + slope]
    gradient = np.array([ratio if j == slope else -ratio if j == activation else 0.0 for j in free])
    if "exchange_current_a" in std:
        std["exchange_current_a"] = math.sqrt(gradient @ covariance @ gradient)
    return std


def _rms(error_v: Floats) -> float:
    return float(np.sqrt((error_v**2).mean()))
