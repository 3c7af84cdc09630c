"""Bounds of a1..a12 in the adaptive law (3.18), as printed in Table 10 of the thesis."""

from bms_estimator.model.cell import Bounds, CellModel, load_cell


def printed_bounds(cell: CellModel) -> dict[str, Bounds]:
    """Return the bounds and initial values of a1..a12 of Table 10, scaled from the pack of the thesis to ``cell``.

    Resistances scale with the number of cells in series over the capacity, capacitances with its inverse. Exponents are
    not scaled. No capture influences these bounds.
    """
    printed = load_cell("thunder_power_6s")
    ohm_ratio = (cell.cell.series_count * printed.cell.capacity_ah) / (
        printed.cell.series_count * cell.cell.capacity_ah
    )
    scaled_bounds = {}
    for name, bounds in printed.adaptation.items():
        element, coefficient = divmod(int(name[1:]) - 1, 3)
        # each element has an amplitude, an exponent (1) and an offset; elements 2 and 3 are capacitances
        factor = 1.0 if coefficient == 1 else 1.0 / ohm_ratio if element in (2, 3) else ohm_ratio
        table = bounds.model_dump()
        scaled = {key: factor * table[key] for key in ("upper", "lower", "initial") if table[key] is not None}
        scaled_bounds[name] = Bounds.model_validate(table | scaled)
    return scaled_bounds
