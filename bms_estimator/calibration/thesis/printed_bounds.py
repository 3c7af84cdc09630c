"""Bounds of (3.18) that are known before anything is measured: Table 10 of the thesis."""

from bms_estimator.model.cell import Bounds, CellModel, load_cell


def printed_bounds(cell: CellModel) -> dict[str, Bounds]:
    """Return Table 10's bounds and initial values of a1..a12, scaled from its pack to ``cell``.

    Resistances scale with the cells in series over the capacity, capacitances with the inverse; exponents stay. No
    capture has a part in them.
    """
    printed = load_cell("thunder_power_6s")
    ohm = (cell.cell.series_count * printed.cell.capacity_ah) / (printed.cell.series_count * cell.cell.capacity_ah)
    found = {}
    for name, bounds in printed.adaptation.items():
        element, place = divmod(int(name[1:]) - 1, 3)
        factor = 1.0 if place == 1 else 1.0 / ohm if element in (2, 3) else ohm
        table = bounds.model_dump()
        scaled = {key: factor * table[key] for key in ("upper", "lower", "initial") if table[key] is not None}
        found[name] = Bounds.model_validate(table | scaled)
    return found
