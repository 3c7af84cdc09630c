"""Packs of one type: they share an estimator's settings, which take longer to make than a day's samples to estimate."""

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import pack_identity
from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import estimator_of
from bms_estimator.model.cell import CellModel
from bms_estimator.model.fuel_cell import PackModel
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.telemetry.charge_energy import ChargeEnergy, ChargeEnergyMeter

MAX_TYPES = 256
"""Maximum number of cached types, 40 kB each; others are made again each time, in 50 ms."""
Digest = tuple[int, int]
"""The first 128 bits, as two words."""


@dataclass(frozen=True, eq=False)
class PackType:
    """Settings, estimator and digests that packs of one type share.

    Attributes:
        settings: Settings of the packs, but for the name.
        made_of: Digest of all that the estimator is made of.
        state_digest: Digest of all that gives a state its meaning; under another one it restarts.
        estimator: Works on the record of the partition.
        meter: Counts for one pack after the other.
        capacity_ah: Capacity of the pack, rated; None of a fuel cell.
    """

    settings: PackSettings
    made_of: Digest
    state_digest: Digest
    estimator: Estimator
    meter: ChargeEnergyMeter
    capacity_ah: float | None


@dataclass(frozen=True)
class _Recipe:
    made_of: Digest
    settings: Settings = field(compare=False)
    cell: PackModel = field(compare=False)


def config_digest(settings: Settings, cell: PackModel) -> Digest:
    """Digest of all that a pack's estimator is made of."""
    sensor = settings.sensor
    parts = (
        *(settings.observer, settings.identifier, settings.sampling, settings.pack.initial_soc, cell),
        *(sensor.voltage_resolution_v, sensor.voltage_noise_v, sensor.current_sign),
    )
    return _digest(hashlib.sha256(repr(parts).encode()).digest())


class PackTypes:
    """The types of a partition's packs.

    Args:
        record: What their estimators work on, shape (1,), dtype PACK_STATE.
    """

    def __init__(self, record: NDArray[np.void]) -> None:
        self._record = record
        self._known: dict[tuple[int, int], tuple[Settings, PackModel, PackType]] = {}

    def of(self, settings: Settings, cell: PackModel) -> PackType:
        """Return the type of packs with these settings; cached by the identity of both objects.

        Args:
            settings: Settings of the packs.
            cell: A pack as one object (``CellModel.pack``).
        """
        key = id(settings), id(cell)
        if key not in self._known:
            if len(self._known) >= MAX_TYPES:
                self._known.clear()
            self._known[key] = settings, cell, pack_type(settings, cell, self._record)
        return self._known[key][2]


def pack_type(settings: Settings, cell: PackModel, record: NDArray[np.void]) -> PackType:
    """Make the type of packs with these settings.

    Args:
        settings: The pack's.
        cell: The pack as one object (``CellModel.pack``).
        record: What its estimator and meter work on, shape (1,), dtype PACK_STATE.
    """
    made = config_digest(settings, cell)
    estimator = type_estimator(settings, cell).bound_to_record(record["estimator"])
    return PackType(
        settings=settings.pack,
        made_of=made,
        state_digest=_digest(bytes.fromhex(pack_identity(settings, cell))),
        estimator=estimator,
        meter=ChargeEnergyMeter(ChargeEnergy(), float(estimator.settings["gap_s"][0]), record["flow"]["sums"]),
        capacity_ah=cell.cell.capacity_ah if isinstance(cell, CellModel) else None,
    )


def type_estimator(settings: Settings, cell: PackModel) -> Estimator:
    """Return the estimator of packs with these settings, shared by all partitions of a process.

    Args:
        settings: Settings of the packs.
        cell: A pack as one object (``CellModel.pack``).
    """
    return _estimator(_Recipe(config_digest(settings, cell), settings, cell))


@lru_cache(maxsize=MAX_TYPES)
def _estimator(recipe: _Recipe) -> Estimator:
    return estimator_of(recipe.settings, recipe.cell)


def _digest(sha256: bytes) -> Digest:
    return int.from_bytes(sha256[:8]), int.from_bytes(sha256[8:16])
