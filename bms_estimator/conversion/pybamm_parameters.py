"""Parameters of PyBaMM's Thevenin model as the text of a Python module. PyBOP uses the same parameters.

A cell with an RC ladder becomes a series resistance and six RC pairs. The voltage of a ladder's RC pair is the filtered
current x times R(SOC), so that it follows a change of R at once. The voltage v of PyBaMM's RC pair relaxes towards I R
instead. Both are equal with the effective resistance R / (1 + tau I R'(SOC) / (3600 Q R)), which follows from
dv/dt = R dx/dt + x R'(SOC) dSOC/dt.

A cell without a ladder becomes R_s and the two RC pairs (2.5)-(2.9) of the thesis.
"""

from bms_estimator.conversion.circuit import ladder_table, ocv_table
from bms_estimator.kernels.cell_model.open_loop import MIN_CAPACITANCE
from bms_estimator.kernels.cell_model.rc_ladder import BRANCHES, GAS_J, STRONG_J, TAU_S, WEAK_J
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel
from bms_estimator.model.cell_file import DIGITS
from bms_estimator.version import __version__

LINE_VALUES = 8
"""Number of values on a line of a list."""

# Parts of the module: HEAD, then LADDER or TWO_PAIRS, then VALUES with one PAIR for each RC pair.

HEAD = '''\
"""PyBaMM parameters of the cell {name} for the Thevenin equivalent circuit model. PyBOP uses the same parameters.

{description}
Written by bms-estimator {version}. Save this file as {name}.py:

    import pybamm
    import {name}

    model = pybamm.equivalent_circuit.Thevenin(options={name}.OPTIONS)
    values = pybamm.ParameterValues({name}.get_parameter_values())
    solution = pybamm.Simulation(model, parameter_values=values).solve([0, 600])

The current is positive on discharge. The OCV is the mean of those after charge and after discharge, at
"Ambient temperature [K]". The cell does not warm up, because cell files contain no thermal parameters:
replace those below if you know them.
"""

import numpy as np
import pybamm

OPTIONS = {{"number of rc elements": {pairs}}}
CAPACITY_AH = {capacity_ah!r}

OCV_SOC = {ocv_soc}
OCV_V = {ocv_v}
OCV_V_PER_K = {per_kelvin_v}


def open_circuit_voltage(soc):
    """Return the OCV [V]."""
    ocv_v = pybamm.Interpolant(OCV_SOC, OCV_V, soc, interpolator="pchip")
    per_kelvin_v = pybamm.Interpolant(OCV_SOC, OCV_V_PER_K, soc)
    return ocv_v + per_kelvin_v * (pybamm.Parameter("Ambient temperature [K]") - 298.15)


def entropic_change(ocv_v, temperature_c):
    """Return the temperature coefficient of the OCV [V/K]."""
    return pybamm.Interpolant(OCV_V, OCV_V_PER_K, ocv_v)

'''

LADDER = '''
SOC = {soc}
# Rows: series resistance, then the resistance of each RC pair, at 25 degC [ohm]. The first part has the activation energy
# {weak_j:g} J/mol, the second {strong_j:g} J/mol.
WEAK_OHM = {weak_ohm}
STRONG_OHM = {strong_ohm}
TAU_S = {tau_s!r}
EDGE = 1e-9  # SOC over which the slope changes at a node


def arrhenius(energy_j, temperature_c):
    """Return the factor on a resistance with an activation energy [J/mol]; 1 at 25 degC."""
    return pybamm.exp(energy_j / {gas_j!r} * (1 / (temperature_c + 273.15) - 1 / 298.15))


def at_soc(rows, k, soc):
    """Return row k at the SOC."""
    return pybamm.Interpolant(SOC, rows[k], soc)


def slope_at_soc(rows, k, soc):
    """Return the slope over SOC of row k, which is constant between two nodes."""
    edges = np.repeat(SOC, 2)[1:-1] + EDGE * np.tile([0, -1], SOC.size - 1)
    return pybamm.Interpolant(edges, np.repeat(np.diff(rows[k]) / np.diff(SOC), 2), soc)


def scaled(table, k, temperature_c, soc):
    """Return the sum of both parts of row k, scaled to the temperature."""
    return arrhenius({weak_j!r}, temperature_c) * table(WEAK_OHM, k, soc) + arrhenius(
        {strong_j!r}, temperature_c
    ) * table(STRONG_OHM, k, soc)


def series_ohm(temperature_c, current_a, soc):
    """Return the series resistance [ohm]."""
    return scaled(at_soc, 0, temperature_c, soc)


def pair_ohm(k, temperature_c, current_a, soc):
    """Return the effective resistance of RC pair k [ohm].

    The voltage v = R(SOC) x follows a change of R at once. The denominator makes the RC pair follow in the same way. Near
    empty, where R rises steeply, the effective resistance can be negative.
    """
    ohm = scaled(at_soc, k, temperature_c, soc)
    slope_ohm = scaled(slope_at_soc, k, temperature_c, soc)
    charge_as = 3600 * pybamm.Parameter("Cell capacity [A.h]")
    return ohm / (1 + TAU_S[k - 1] * current_a * slope_ohm / (charge_as * ohm))


def pair_farad(k, temperature_c, current_a, soc):
    """Return the capacitance of RC pair k [F]."""
    return TAU_S[k - 1] / scaled(at_soc, k, temperature_c, soc)

'''

TWO_PAIRS = '''
A = {a}  # a1 to a15 of the thesis at index 1 to 15


def series_ohm(temperature_c, current_a, soc):
    """Return R_s [ohm], (2.9)."""
    return A[13] * pybamm.exp(-A[14] * soc) + A[15]


def pair_ohm(k, temperature_c, current_a, soc):
    """Return R_ts (k = 1) or R_tl (k = 2) [ohm], (2.5) and (2.6)."""
    first = 3 * k - 2
    return A[first] * pybamm.exp(-A[first + 1] * soc) + A[first + 2]


def pair_farad(k, temperature_c, current_a, soc):
    """Return C_ts (k = 1) or C_tl (k = 2) [F], (2.7) and (2.8), which are negative near empty and therefore limited."""
    first = 3 * k + 4
    farad = -A[first] * pybamm.exp(-A[first + 1] * soc) + A[first + 2]
    return pybamm.maximum(farad, {min_capacitance!r} * A[first + 2])

'''

VALUES = '''
def get_parameter_values():
    """Return the values for pybamm.ParameterValues."""
    return {{
        "chemistry": "ecm",
        "Initial SoC": 0.5,
        "Cell capacity [A.h]": CAPACITY_AH,
        "Nominal cell capacity [A.h]": CAPACITY_AH,
        "Current function [A]": CAPACITY_AH,
        "Lower voltage cut-off [V]": {voltage_min_v!r},
        "Upper voltage cut-off [V]": {voltage_max_v!r},
        "Ambient temperature [K]": 298.15,
        "Initial temperature [K]": 298.15,
        "Cell thermal mass [J/K]": 1e9,
        "Jig thermal mass [J/K]": 1e9,
        "Cell-jig heat transfer coefficient [W/K]": 0,
        "Jig-air heat transfer coefficient [W/K]": 0,
        "Entropic change [V/K]": entropic_change,
        "Open-circuit voltage [V]": open_circuit_voltage,
        "R0 [Ohm]": series_ohm,
{pairs}
    }}
'''
PAIR = """\
        "R{k} [Ohm]": lambda temperature_c, current_a, soc: pair_ohm({k}, temperature_c, current_a, soc),
        "C{k} [F]": lambda temperature_c, current_a, soc: pair_farad({k}, temperature_c, current_a, soc),
        "Element-{k} initial overpotential [V]": 0,"""


def pybamm_module(cell: CellModel) -> str:
    """Return the text of a Python module whose ``get_parameter_values`` returns PyBaMM's parameters of the cell."""
    ocv, ratings = ocv_table(cell), cell.cell
    pairs = 2 if cell.ladder is None else BRANCHES
    head = HEAD.format(
        name=_docstring_text(ratings.name),
        description=_docstring_text(ratings.description),
        version=__version__,
        pairs=pairs,
        capacity_ah=ratings.capacity_ah,
        ocv_soc=_array(ocv.soc),
        ocv_v=_array(ocv.ocv_v),
        per_kelvin_v=_array(ocv.per_kelvin_v),
    )
    values = VALUES.format(
        voltage_min_v=ratings.voltage_min_v,
        voltage_max_v=ratings.voltage_max_v,
        pairs="\n".join(PAIR.format(k=k) for k in range(1, pairs + 1)),
    )
    return head + (_two_pairs(cell) if cell.ladder is None else _ladder(cell)) + values


def _ladder(cell: CellModel) -> str:
    table = ladder_table(cell)
    return LADDER.format(
        soc=_array(table.soc),
        weak_ohm=_matrix(table.weak_ohm),
        strong_ohm=_matrix(table.strong_ohm),
        tau_s=TAU_S,
        weak_j=WEAK_J,
        strong_j=STRONG_J,
        gas_j=GAS_J,
    )


def _two_pairs(cell: CellModel) -> str:
    return TWO_PAIRS.format(a=[None, *cell.a[1:16].tolist()], min_capacitance=MIN_CAPACITANCE)


def _docstring_text(text: str) -> str:
    """Return a text without quotes and backslashes, because a cell file from another person must not end the docstring."""
    return " ".join(text.replace("\\", "/").replace('"', "'").split())


def _array(values: Floats) -> str:
    """Return a numpy array as Python text; the zeros of a missing column are not listed."""
    if not values.any():
        return f"np.zeros({values.size})"
    texts = _numbers(values)
    lines = [", ".join(texts[i : i + LINE_VALUES]) for i in range(0, len(texts), LINE_VALUES)]
    return "np.array([\n    " + ",\n    ".join(lines) + ",\n])"


def _matrix(rows: Floats) -> str:
    return "np.array([\n    " + ",\n    ".join(f"[{', '.join(_numbers(row))}]" for row in rows) + ",\n])"


def _numbers(values: Floats) -> list[str]:
    """Return numbers as Python text, rounded as in a cell file."""
    return [repr(float(f"{x:.{DIGITS}g}")) for x in values.tolist()]
