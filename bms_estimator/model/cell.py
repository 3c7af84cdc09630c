"""Cell model: contents of a cell file, with a1..a21 (``cell_sections``), and the shipped, generic and user's cell files.

Numbers in parentheses are equations of the thesis, and lemmas are those of the thesis.

The values describe ``series_count`` cells in series as one two-terminal object. ``CellModel.pack`` scales them to packs
of such objects in series and parallel.
"""

import math
import tomllib
from collections.abc import Callable, Sequence
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from bms_estimator.model.cell_sections import (
    CAPACITANCE_NUMBERS,
    DEFAULT_RATE,
    ELEMENTS,
    Bounds,
    Capacitance,
    ChenMoraOcv,
    Ladder,
    Resistance,
    TableOcv,
)
from bms_estimator.model.config_file import Positive, Strict, read_toml, suggestion
from bms_estimator.model.errors import UserError

Result = TypeVar("Result")
"""Result of ``CellModel.by_kind``."""
MAX_C_RATE = 100.0
"""Highest possible current as a C-rate [1/h]. Power cells give 50 C. A higher current is a short circuit, which
the fuse or the cell ends within a second."""


class Rated(Strict):
    """Ratings that every pack has."""

    name: str
    description: str = ""
    series_count: Annotated[int, Field(ge=1)] = Field(default=1, description="cells in series that the values describe")
    nominal_voltage_v: Positive
    voltage_min_v: Positive = Field(description="samples below this voltage are rejected")
    voltage_max_v: Positive = Field(description="samples above this voltage are rejected")
    current_max_a: Positive = Field(description="samples with a current of larger magnitude are rejected")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.voltage_min_v < self.nominal_voltage_v < self.voltage_max_v:
            raise ValueError(
                f"voltage_min_v = {self.voltage_min_v}, nominal_voltage_v = {self.nominal_voltage_v}, "
                f"voltage_max_v = {self.voltage_max_v}: must increase in this order"
            )
        return self


class Cell(Rated):
    """Ratings of the cell."""

    capacity_ah: Positive = Field(description="rated capacity in ampere-hours")
    capacity_std: Annotated[float, Field(ge=0, le=0.3)] | None = Field(
        default=None, description="relative standard deviation of capacity_ah; default: that of most cells"
    )


class Grade(StrEnum):
    """Quality of a cell model."""

    GOOD = "good"
    FAIR = "fair"
    POOR = "poor"


class Fit(Strict):
    """Captures to which a cell file was fitted, and the result of its validation."""

    captures: tuple[str, ...] = Field(default=(), description="digests of the captures' samples")
    grade: Grade | None = Field(
        default=None, description="grade on data that were held back from the fit; default: not validated"
    )


class CellModel(Strict):
    """Contents of a cell file: ratings, elements (2.5)-(2.9), OCV, RC ladder, bounds of the adaptive law, and the fit."""

    cell: Cell
    r_ts: Resistance
    r_tl: Resistance
    c_ts: Capacitance
    c_tl: Capacitance
    r_s: Resistance
    ocv: Annotated[ChenMoraOcv | TableOcv, Field(discriminator="form")]
    ladder: Ladder | None = Field(default=None, description="RC ladder; default: computed from the elements")
    adaptation: dict[str, Bounds] = Field(default_factory=dict, description="bounds by parameter, keys a1 to a15")
    # repr=False: identities of checkpoints are hashes of the repr, and do not depend on the origin of the values
    fit: Fit | None = Field(default=None, repr=False, description="captures that the values were fitted to")
    no_forecast_reason: ClassVar[str] = "the identifier is switched off"
    """Reason to report if the estimator of this model makes no forecasts."""
    always_learns: ClassVar[bool] = False
    """False: the observer uses the configured law."""
    min_voltage_ratio: ClassVar[float] = 0.6
    """Minimum voltage relative to the nominal voltage. A full pack with half as many cells has less."""

    @model_validator(mode="after")
    def _known_parameters(self) -> Self:
        known = {f"a{i}" for i in range(1, 16)}
        for name in self.adaptation:
            if name not in known:
                raise ValueError(f"adaptation.{name}: no such parameter; a1 to a15 adapt")
        return self

    def by_kind(self, battery: Callable[["CellModel"], Result], _stack: object) -> Result:
        """Return ``battery(self)``. The model of a fuel cell calls the second function instead."""
        return battery(self)

    def battery(self, _error: str) -> "CellModel":
        """Return this model. The model of a fuel cell raises a UserError with the text ``_error`` instead."""
        return self

    @property
    def capacity_ah(self) -> float:
        """Rated capacity [Ah]."""
        return self.cell.capacity_ah

    @property
    def capacity_text(self) -> str:
        """Rated capacity with its unit."""
        return f"{self.capacity_ah:g} Ah"

    @property
    def one_c_a(self) -> float:
        """Current of one C [A]."""
        return self.capacity_ah

    @property
    def possible_a(self) -> float:
        """Highest possible current [A]."""
        return MAX_C_RATE * self.capacity_ah

    def state_basis(self, current_sign: str) -> tuple[float | str, ...]:
        """Return all numbers on which the meaning of a saved state depends."""
        curve = self.ocv.a if isinstance(self.ocv, ChenMoraOcv) else (*self.ocv.soc, *self.ocv.ocv_v)
        return (self.cell.series_count, self.capacity_ah, current_sign, *curve)

    @property
    def a(self) -> NDArray[np.float64]:
        """Parameters a1..a21 at index 1..21, shape (22,); a16..a21 are NaN unless the OCV has the form (2.10)."""
        ocv = self.ocv.a if isinstance(self.ocv, ChenMoraOcv) else (np.nan,) * 6
        return np.array([np.nan, *self.r_ts.a, *self.r_tl.a, *self.c_ts.a, *self.c_tl.a, *self.r_s.a, *ocv])

    def bounds(self, index: int) -> Bounds:
        """Return the configured bounds of a_index.

        Without configured bounds, these are a quarter and four times the model's value, with that value as limit.
        """
        configured = self.adaptation.get(f"a{index}")
        if configured is not None:
            return configured
        value = float(self.a[index])
        rate = DEFAULT_RATE
        if index in (9, 12) and self.a[index - 2] > value:
            # Lemma 4.1.1: the rate of a9 (a12) must exceed that of a7 (a10), but by less than the ratio of both values
            rate *= float(np.sqrt(self.a[index - 2] / value))
        return Bounds(upper=4.0 * value, lower=0.25 * value, weight_upper=0.2 * rate, weight_lower=0.8 * rate)

    def pack(self, series: int, parallel: int) -> "CellModel":
        """Return the model of ``series`` x ``parallel`` cells, with all values scaled."""
        if series == parallel == 1:
            return self
        return _scaled(self, series, parallel)


def _scaled(model: CellModel, series: int, parallel: float) -> CellModel:
    """Return the model of ``series`` x ``parallel`` cells. The unit in the name of a value determines its factor.

    ``parallel`` need not be an integer, because generic cells of 1 Ah are scaled to a capacity.
    """
    ohm, farad = series / parallel, parallel / series

    def scaled_by_unit(part: Strict, factor: dict[str, float]) -> dict[str, object]:
        table = part.model_dump()
        for key, value in table.items():
            unit = key.rsplit("_", 1)[-1]
            if unit in factor and value is not None:
                table[key] = _product(value, factor[unit])
        return table

    factor = {"ohm": ohm, "farad": farad, "v": float(series), "a": parallel, "ah": parallel}
    elements = {name: scaled_by_unit(getattr(model, name), factor) for name in ELEMENTS}
    adaptation = {}
    for name, bounds in model.adaptation.items():
        element, coefficient = divmod(int(name[1:]) - 1, 3)  # coefficient 0: amplitude, 1: exponent, 2: offset
        scale = 1.0 if coefficient == 1 else farad if element in CAPACITANCE_NUMBERS else ohm
        table = bounds.model_dump()
        adaptation[name] = table | {k: table[k] * scale for k in ("upper", "lower", "initial") if table[k] is not None}
    cell = scaled_by_unit(model.cell, factor) | {"series_count": model.cell.series_count * series}
    ladder = None if model.ladder is None else scaled_by_unit(model.ladder, factor)
    return CellModel.model_validate(
        {
            "cell": cell,
            "ocv": scaled_by_unit(model.ocv, factor),
            "ladder": ladder,
            "adaptation": adaptation,
            "fit": model.fit,
        }
        | elements
    )


def _product(value: Any, factor: float) -> Any:
    """Multiply a number, or each number of a table, by ``factor``."""
    return tuple(_product(v, factor) for v in value) if isinstance(value, tuple) else value * factor


def shipped_cells() -> list[str]:
    """Return the names of the shipped cells."""
    return _shipped_names("cells")


def generic_cells() -> list[str]:
    """Return the names of the generic cells, one for each chemistry."""
    return _shipped_names("cells/generic")


def shipped_fuel_cells() -> list[str]:
    """Return the names of the shipped fuel cells."""
    return _shipped_names("cells/fuel_cell")


def battery_names() -> list[str]:
    """Return the names of the generic and the shipped cells."""
    return [*generic_cells(), *shipped_cells()]


def cell_names() -> list[str]:
    """Return the names of the generic cells, the shipped cells and the shipped fuel cells."""
    return [*battery_names(), *shipped_fuel_cells()]


def is_fuel_cell(name_or_path: str | Path) -> bool:
    """Return True for the name or readable file of a fuel cell, which has a section ``[fuel_cell]``."""
    if str(name_or_path) in shipped_fuel_cells():
        return True
    try:
        return "fuel_cell" in tomllib.loads(Path(name_or_path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False  # read_toml reports errors of the file later


def _shipped_names(folder: str) -> list[str]:
    """Return the names of the shipped files in ``folder``, without ``.toml``."""
    entries = (resources.files("bms_estimator.model") / folder).iterdir()
    return sorted(Path(entry.name).stem for entry in entries if entry.name.endswith(".toml"))


def load_cell(name_or_path: str | Path, capacity_ah: float | None = None) -> CellModel:
    """Load a generic or shipped cell by name, or a cell file by path.

    Args:
        name_or_path: Name in ``generic_cells`` or ``shipped_cells``, otherwise a path.
        capacity_ah: Capacity [Ah]. A generic cell requires a capacity, with which its resistances and capacitances are
            scaled. In any other cell the argument replaces only the capacity, because the resistances were measured.

    Raises:
        UserError: No such cell or file, an invalid value in the file, a missing or invalid capacity, or a fuel cell, which
            has neither SOC nor capacity.
    """
    text = str(name_or_path)
    if is_fuel_cell(text):
        raise UserError(
            f"{text} is a fuel cell, which has no state of charge, capacity or OCV: this needs a battery cell"
        )
    if capacity_ah is not None and not 0.0 < capacity_ah < math.inf:
        raise UserError(f"capacity_ah = {capacity_ah}: must be above 0 (capacity in ampere-hours)")
    if text in generic_cells():
        if capacity_ah is None:
            raise UserError(f"{text} is a generic cell: give its capacity, capacity_ah of [pack] or --capacity-ah")
        return _scaled(_read_shipped(f"cells/generic/{text}.toml"), series=1, parallel=capacity_ah)
    is_shipped = text in shipped_cells()
    cell = _read_shipped(f"cells/{text}.toml") if is_shipped else read_toml(cell_file_path(text), CellModel)
    return cell if capacity_ah is None else with_capacity(cell, capacity_ah)


def with_capacity(cell: CellModel, capacity_ah: float, relative_std: float | None = None) -> CellModel:
    """Return the cell with another capacity [Ah], its relative std (None: unknown), and unchanged resistances.

    The grade of the cell's validation does not apply to another capacity.
    """
    ratings = cell.cell.model_copy(update={"capacity_ah": capacity_ah, "capacity_std": relative_std})
    if cell.fit is None or capacity_ah == cell.cell.capacity_ah:
        return cell.model_copy(update={"cell": ratings})
    return cell.model_copy(update={"cell": ratings, "fit": cell.fit.model_copy(update={"grade": None})})


def fitted_to(cell: CellModel, captures: Sequence[str], grade: Grade | None = None) -> CellModel:
    """Return the cell with the digests of the captures that it was fitted to, in addition to those that it has.

    Args:
        cell: The cell.
        captures: Digests by ``capture_digest``.
        grade: Grade on data that were held back from the fit; None: not validated.
    """
    if cell.fit is None and not captures:
        return cell
    earlier = cell.fit.captures if cell.fit else ()
    return cell.model_copy(update={"fit": Fit(captures=tuple(dict.fromkeys([*earlier, *captures])), grade=grade)})


def with_name(cell: CellModel, name: str) -> CellModel:
    """Return the cell with another name."""
    return cell.model_copy(update={"cell": cell.cell.model_copy(update={"name": name})})


def _read_shipped(name: str) -> CellModel:
    """Read a shipped cell file; ``name`` is its path within the folder of this module."""
    with resources.as_file(resources.files("bms_estimator.model") / name) as path:
        return read_toml(path, CellModel)


def cell_file_path(text: str) -> Path:
    """Return the path of a cell file.

    Raises:
        UserError: The file does not exist.
    """
    path = Path(text)
    if not text or not path.exists():
        raise UserError(
            f"{text or '(empty name)'}: no such cell file, nor a shipped cell ({', '.join(shipped_cells())}), "
            f"nor a generic one ({', '.join(generic_cells())}), nor a fuel cell ({', '.join(shipped_fuel_cells())})"
            f"{suggestion(text, cell_names())}"
        )
    return path
