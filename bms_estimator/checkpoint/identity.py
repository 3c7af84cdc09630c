"""Identity of a checkpoint: pack and settings of its state."""

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.model.cell import ChenMoraOcv
from bms_estimator.model.fuel_cell import FuelCellModel, PackModel
from bms_estimator.settings.pack import Settings


def pack_identity(settings: Settings, cell: PackModel) -> str:
    """Hash of what gives the state its meaning: cells in series, capacity, open-circuit voltage, sign of the current.

    Of a fuel cell: all its parameters and the sign.

    Plain numbers and not the sections of the settings: a new description, tuning value or setting does not change the
    meaning.
    """
    if isinstance(cell, FuelCellModel):  # theta is over the file's values
        return hashlib.sha256(repr((*cell.a, settings.sensor.current_sign)).encode()).hexdigest()
    ocv = cell.ocv
    curve = ocv.a if isinstance(ocv, ChenMoraOcv) else (*ocv.soc, *ocv.ocv_v)
    meaning = (cell.cell.series_count, cell.cell.capacity_ah, settings.sensor.current_sign, *curve)
    return hashlib.sha256(repr(meaning).encode()).hexdigest()


def observer_identity(settings: Settings, cell: PackModel) -> str:
    """Return the hash of all that the observer's parameters and gain depend on; under other settings they restart within seconds."""
    parts = (settings.observer, cell, settings.sensor.voltage_resolution_v)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def fields(record: NDArray[np.void], part: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Each field of a structured array, as a view, under its name; those of its parts as ``part.field``."""
    for name in record.dtype.names or ():
        if record[name].dtype.names:
            yield from fields(record[name], f"{part}{name}.")
        else:
            yield f"{part}{name}", record[name]


def without_observer(state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the fields of a state that stay valid under other observer settings: all but the observer's own."""
    kept = "observer.soc", "observer.soc_coulomb", "observer.started"
    dropped = "observer.", "learning.", "series_resistance."
    return {name: v for name, v in state.items() if name in kept or not name.startswith(dropped)}
