"""Open-loop response of a fuel cell to a measured current."""

import numpy as np

from bms_estimator.kernels.cell_model.current_interpolation import interpolated_current
from bms_estimator.kernels.cell_model.fuel_cell import advance, load_file_constants, output, steady_state
from bms_estimator.model.arrays import Floats
from bms_estimator.numba_cache import njit


@njit(cache=True)
def open_loop(
    file: Floats, theta: Floats, time_s: Floats, current_a: Floats, temperature_c: Floats
) -> tuple[Floats, Floats]:
    """Simulate the voltage at each sample, from the steady state under the first current.

    Args:
        file: Constants of the file, shape (16,).
        theta: Logarithm of each parameter relative to the file's value, shape (8,).
        time_s: Shape (n,), increasing [s].
        current_a: Shape (n,), positive when the stack delivers power [A].
        temperature_c: Shape (n,), NaN without a sensor [C].

    Returns:
        Voltage [V], shape (n,), and its derivatives by theta, shape (n, 8).
    """
    n = time_s.size
    voltage_v, psi = np.empty(n), np.zeros((n, theta.size))
    x, dx, constants = np.zeros(2), np.zeros((2, theta.size)), np.zeros(theta.size)
    for j in range(n):
        load_file_constants(constants, file, temperature_c[j])
        if j == 0:
            steady_state(x, dx, theta, constants, current_a[0])
        else:
            dt_s = time_s[j] - time_s[j - 1]
            advance(x, dx, theta, constants, interpolated_current(dt_s, current_a[j - 1], current_a[j]), dt_s)
        voltage_v[j] = output(x, dx, theta, constants, current_a[j], psi[j])
    return voltage_v, psi


@njit(cache=True)
def polarisation(file: Floats, theta: Floats, current_a: Floats, temperature_c: Floats) -> tuple[Floats, Floats]:
    """Return the steady-state voltage under each current [V], and its derivatives by theta.

    The arguments are those of ``open_loop``.
    """
    n = current_a.size
    voltage_v, psi = np.empty(n), np.zeros((n, theta.size))
    x, dx, constants = np.zeros(2), np.zeros((2, theta.size)), np.zeros(theta.size)
    for j in range(n):
        load_file_constants(constants, file, temperature_c[j])
        steady_state(x, dx, theta, constants, current_a[j])
        voltage_v[j] = output(x, dx, theta, constants, current_a[j], psi[j])
    return voltage_v, psi
