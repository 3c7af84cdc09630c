"""Type of packs. All packs of a type share one ``Pack``, because its creation takes longer than estimating a day's samples."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bms_estimator.checkpoint.identity import pack_identity
from bms_estimator.estimator.cell_estimator import CellEstimator
from bms_estimator.estimator.estimator import Estimator, make_estimator
from bms_estimator.estimator.settings_plausibility import forecast_end_v
from bms_estimator.model.cell import CellModel
from bms_estimator.model.pack_model import PackModel
from bms_estimator.pack.pack import Pack, assemble
from bms_estimator.pack_model.slow_fit import SlowFit
from bms_estimator.settings.alarm_limits import monitored_alarms, short_limit_a
from bms_estimator.settings.alarms import AlarmName
from bms_estimator.settings.observer import NO_LIMITS
from bms_estimator.settings.pack import PackSettings, Settings
from bms_estimator.telemetry.alarms.definitions import AlarmDefinitions
from bms_estimator.telemetry.publish_window import ChargeEnergy, ChargeEnergyMeter

MAX_TYPES = 256
"""Maximum number of cached types. Creating a type that is not cached takes 50 ms."""
LIVE_ALARMS: frozenset[AlarmName] = frozenset(("collapse_risk", "hook_failed", "alarm_state_lost"))
"""Alarms that a worker does not evaluate. It has neither forecasts nor hooks nor a saved list of alarms."""
Bytes = NDArray[np.uint8]
Digest = tuple[int, int]
"""First 128 bits of a SHA-256 digest as two words."""


@dataclass(frozen=True, eq=False)
class PackType:
    """Settings, ``Pack`` and digests that packs of one type share.

    Attributes:
        settings: Settings of the packs; the name is not used.
        config_digest: Digest of the configuration of the estimator. A state of another digest is migrated.
        state_digest: Digest of the configuration that a state depends on. A state of another digest is reset.
        pack: Pack without forecasts. Its estimator uses the *unpacked record*, the one record of a partition into which the state
            of each pack is decompressed in turn.
        alarms: Definitions of the alarms.
        short_limit_a: Minimum proven self-discharge of a cell with an internal short [A].
        meter: Charge and energy meter bound to the unpacked record.
        capacity_ah: Rated capacity of a pack [Ah]; None for a fuel cell.
        cutoff_v: Voltage at which the load of a pack is switched off [V]; NaN for a fuel cell.
        filter_bytes: View of the settings of the estimator's filter, into which those of the loaded pack are copied. Types with equal
            digests share the estimator, and therefore this array.
        cell_file_bytes: Settings of the filter with the curves of the cell file.
    """

    settings: PackSettings
    config_digest: Digest
    state_digest: Digest
    pack: Pack
    alarms: AlarmDefinitions
    short_limit_a: float
    meter: ChargeEnergyMeter
    capacity_ah: float | None
    cutoff_v: float
    filter_bytes: Bytes
    cell_file_bytes: Bytes

    @property
    def estimator(self) -> Estimator:
        """Estimator bound to the unpacked record of the partition."""
        return self.pack.estimator

    @property
    def cells(self) -> CellEstimator:
        """Estimators of the single cells. They use the state of the loaded pack."""
        assert self.pack.cells is not None  # noqa: S101 - for the type checker: each assembled pack has them
        return self.pack.cells


class WorkerFit(SlowFit):
    """Slow fit of the packs of a type, whose histories and fits are outside of the worker.

    Args:
        estimator: Estimator bound to the unpacked record of the partition.
        interval_s: Maximum interval between two fits [s].
        advance: Handles rows and events of the loaded pack (``PackFits.advance``).
    """

    def __init__(self, estimator: Estimator, interval_s: float, advance: "Advance") -> None:
        super().__init__(estimator, interval_s=interval_s)
        self.interval_s, self._advance_loaded = interval_s, advance

    def advance(self) -> None:
        """Handle rows and events of the loaded pack."""
        self._advance_loaded(self)

    def resume(self, gap_s: float, *, restored: bool) -> None:
        """Leave the history unchanged: it continues on the server, and the next block schedules the next fit."""


Advance = Callable[[WorkerFit], None]
"""Function that handles rows and events of the fits of the loaded pack."""


@dataclass(frozen=True)
class _EstimatorKey:
    """Cache key of an estimator; only the digest is compared."""

    config_digest: Digest
    settings: Settings = field(compare=False)
    cell: PackModel = field(compare=False)


def config_digest(settings: Settings, cell: PackModel) -> Digest:
    """Return the digest of all values that a pack's estimator is created from."""
    sensor, limits = settings.sensor, settings.charge_limits
    # limits are a later addition: without them the digest stays that of earlier versions
    optional = () if limits == NO_LIMITS else (limits,)
    parts = (
        settings.observer,
        settings.identifier,
        settings.sampling,
        settings.pack.initial_soc,
        cell,
        sensor.voltage_resolution_v,
        sensor.voltage_noise_v,
        sensor.current_sign,
        *optional,
    )
    return _digest(hashlib.sha256(repr(parts).encode()).digest())


def bytes_of(settings: np.void) -> Bytes:
    """Return a view of a record as bytes. Copying it takes a hundredth of the time of copying the fields."""
    return np.frombuffer(settings, np.uint8)


def state_digest(settings: Settings, cell: PackModel) -> Digest:
    """Return the digest of all values that a pack's state depends on."""
    return _digest(bytes.fromhex(pack_identity(settings, cell)))


class PackTypes:
    """Cache of the types of a partition's packs.

    Args:
        record: Unpacked record of the partition, shape (1,), dtype ``PACK_STATE``.
        advance: Handles rows and events of the fits of the loaded pack.
    """

    def __init__(self, record: NDArray[np.void], advance: Advance) -> None:
        self._record, self._advance = record, advance
        self._types: dict[tuple[int, int], tuple[Settings, PackModel, PackType]] = {}

    def of(self, settings: Settings, cell: PackModel) -> PackType:
        """Return the type of packs with these settings and this model; cached by the identity of both objects."""
        key = id(settings), id(cell)  # unique, because the cached tuple keeps both objects alive
        if key not in self._types:
            if len(self._types) >= MAX_TYPES:
                self._types.clear()
            self._types[key] = settings, cell, pack_type(settings, cell, self._record, self._advance)
        return self._types[key][2]


def pack_type(settings: Settings, cell: PackModel, record: NDArray[np.void], advance: Advance) -> PackType:
    """Create the type of packs with these settings.

    Args:
        settings: Settings of the packs.
        cell: Model of a whole pack.
        record: Unpacked record of the partition.
        advance: Handles rows and events of fits.
    """
    digest = config_digest(settings, cell)
    estimator = type_estimator(settings, cell).bound_to_record(record["estimator"])

    # a worker receives no acknowledgements, without which a latched alarm would never end
    alarms = [each._replace(latch=False) for each in monitored_alarms(settings, cell) if each.name not in LIVE_ALARMS]

    def new_fit(estimator: Estimator, interval_s: float) -> SlowFit:
        return WorkerFit(estimator, interval_s, advance)

    return PackType(
        settings=settings.pack,
        config_digest=digest,
        state_digest=state_digest(settings, cell),
        pack=assemble(estimator, settings, new_fit, has_load=False),
        alarms=AlarmDefinitions.of(alarms, settings, cell, float(estimator.settings["gap_s"][0])),
        short_limit_a=short_limit_a(settings, cell),
        meter=ChargeEnergyMeter(ChargeEnergy(), float(estimator.settings["gap_s"][0]), record["flow"]["sums"]),
        capacity_ah=cell.capacity_ah,
        cutoff_v=forecast_end_v(settings, cell) if isinstance(cell, CellModel) else math.nan,
        filter_bytes=estimator.settings_record["filter"].view(np.uint8),
        cell_file_bytes=bytes_of(estimator.cell_file_settings),
    )


def type_estimator(settings: Settings, cell: PackModel) -> Estimator:
    """Return the estimator of packs with these settings and this model, shared by all partitions of a process."""
    return _estimator(_EstimatorKey(config_digest(settings, cell), settings, cell))


@lru_cache(maxsize=MAX_TYPES)
def _estimator(key: _EstimatorKey) -> Estimator:
    return make_estimator(key.settings, key.cell)


def _digest(sha256: bytes) -> Digest:
    return int.from_bytes(sha256[:8]), int.from_bytes(sha256[8:16])
