"""Identity of a pack: hashes of settings and cell data, by which a saved state is accepted, shortened or rejected."""

import hashlib
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.pack import Settings


def pack_identity(settings: Settings, cell: PackModel) -> str:
    """Return the hash of all numbers on which the meaning of a state depends.

    For a battery, these are the number of cells in series, the capacity, the open-circuit voltage and the sign of the
    current. For a fuel cell, these are all parameters and the sign of the current. A changed description, tuning value
    or other setting does not change the hash.
    """
    return hashlib.sha256(repr(cell.state_basis(settings.sensor.current_sign)).encode()).hexdigest()


def observer_identity(settings: Settings, cell: PackModel) -> str:
    """Return the hash of all settings and cell data on which the observer's parameters and gain depend.

    With another hash the observer's own state is discarded; it converges again within seconds.
    """
    parts = (settings.observer, cell, settings.sensor.voltage_resolution_v)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def without_observer(state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the fields of a state that stay valid with another observer identity."""
    valid = "observer.soc", "observer.soc_coulomb", "observer.started"
    # ``learning`` and ``series_resistance`` are computed from the observer's estimates and are discarded with them
    prefixes = "observer.", "learning.", "series_resistance."
    return {name: v for name, v in state.items() if name in valid or not name.startswith(prefixes)}
