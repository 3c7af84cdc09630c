"""Payload of the topic ``health``: state of the service, of the source and of the fit of the pack's model."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bms_estimator.estimator.identified_parameters import relative_capacity
from bms_estimator.kernels.kalman_filter.anchors import FULL, NO_ANCHOR
from bms_estimator.kernels.kalman_filter.input_checks import COUNTERS
from bms_estimator.kernels.observer.records import OBSERVER_STATE
from bms_estimator.model.arrays import SampleBlock
from bms_estimator.model.clock import iso_utc
from bms_estimator.model.input_faults import InputFault
from bms_estimator.model.payloads.health import (
    AnchorReport,
    EdgeHealth,
    FitReport,
    Health,
    HookHealth,
    LoopHealth,
    PackModelHealth,
    RecordingHealth,
    Totals,
)
from bms_estimator.mqtt.connection import DeliveryStats
from bms_estimator.pack_model.history import DAY_S
from bms_estimator.pack_model.slow_fit import SlowFit

CONTRADICTION_STD, AGREEMENT_STD = 3.0, 2.0
"""Limits of the difference between the estimated SOC and the SOC of the device, in std of the difference: a contradiction is
reported above the first, until the difference is below the second."""
DEVICE_SOC_SUSPICION = (
    "the SOC that the device reports contradicts the voltage: check that the OCV curve belongs to this cell's chemistry, the number of "
    "cells in series and the sign of the current; a device that counts charge is also wrong long after its last full charge"
)
"""Text of this report in the field ``suspects`` of ``health``."""


class FitTimes(NamedTuple):
    """End of the last fit [s since 1970] and its duration [s]; None before the first."""

    finished_s: float | None
    duration_s: float | None


NO_FIT = FitTimes(None, None)


def pack_model_health(model: SlowFit, times: FitTimes) -> PackModelHealth:
    """Return the state of the slow fit.

    Args:
        model: Slow fit; read only.
        times: End and duration of the last fit.
    """
    estimator, rows = model.estimator, model.history.rows
    declared_ah = float(estimator.settings["capacity_as"][0]) / 3600.0
    capacity = relative_capacity(estimator.record[0]) if estimator.state["started"][0] else None
    return PackModelHealth(
        fits=model.fits,
        late=model.late,
        failed=model.failed,
        changes=model.changes,
        rows=rows.size,
        segments=1 + int(np.count_nonzero(np.diff(rows["segment"]))) if rows.size else 0,
        history_days=float(np.ptp(rows["elapsed_s"])) / DAY_S if rows.size else 0.0,
        capacity_ah=capacity.value * declared_ah if capacity else None,
        capacity_std_ah=capacity.std * declared_ah if capacity else None,
        last_fit=None if times.finished_s is None else iso_utc(times.finished_s),
        last_fit_s=times.duration_s,
        change=last_change(model),
        soc_bound=model.saved_fit and model.saved_fit.soc_bound,
    )


def last_change(model: SlowFit) -> FitReport | None:
    """Return the last change of SOC and capacity by a fit; None: no change since start."""
    change, declared_ah = model.last_change, float(model.estimator.settings["capacity_as"][0]) / 3600.0
    if change is None:
        return None
    return FitReport(
        soc_before=change.soc_before,
        soc_after=change.soc_after,
        capacity_before_ah=change.capacity_before * declared_ah,
        capacity_after_ah=change.capacity_after * declared_ah,
    )


_PAGE_MIB = os.sysconf("SC_PAGE_SIZE") / 2**20
"""Size of a memory page [MiB]."""
_SAMPLE_COUNTERS = [
    name
    for name in OBSERVER_STATE.names or ()
    if name.startswith("dropped_") or name in ("samples", "gaps", "time_steps_back")
]
"""Fields of OBSERVER_STATE that count samples."""
MAX_SERIES_FACTOR = 200
"""Maximum suggested number of cells in series, relative to the configured number. An 800 V vehicle has as many cells."""


def resident_mib() -> float | None:
    """Return the resident memory of this process [MiB]; None if the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * _PAGE_MIB
    except OSError:
        return None


def sample_counters(state: np.void) -> dict[str, int]:
    """Return the samples accepted and dropped by kind, from a record of OBSERVER_STATE."""
    return dict(zip(_SAMPLE_COUNTERS, state[_SAMPLE_COUNTERS].item(), strict=True))


def dropped_text(dropped: Mapping[str, int]) -> str:
    """Return a description of dropped samples: the number of each kind. ``dropped`` has names without ``dropped_``."""
    words = {"range": "outside the cell's range", "contradicted": "with a current that the voltage does not follow"}
    return ", ".join(f"{n:,} {words.get(kind, kind).replace('_', ' ')}" for kind, n in dropped.items() if n) or "none"


def identifier_counters(record: np.void) -> dict[str, int]:
    """Return counters of the filter's rejected inputs and resets, from a record of ESTIMATOR_STATE.

    ``searched`` is the number of re-initializations of the SOC.
    """
    counts = zip(COUNTERS.names or (), record["counters"].item(), strict=True)
    anchors = {name: int(record["anchors"][name]) for name in ("full_anchors", "empty_anchors")}
    return dict(counts) | {"searched": int(record["filter"]["reopened"])} | anchors


def last_anchor(record: np.void) -> AnchorReport | None:
    """Return the last end of a charge or discharge, from a record of ESTIMATOR_STATE; None before the first end."""
    a = record["anchors"]
    if a["last"] == NO_ANCHOR:
        return None
    return AnchorReport(
        kind="full" if a["last"] == FULL else "empty",
        soc_before=float(a["soc_before"]),
        soc_std_before=float(a["soc_std_before"]),
        soc_after=float(a["soc_after"]),
    )


def suspicions(record: np.void, settings: np.void) -> list[str]:
    """Return the filter's suspicions of its input, one sentence each.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
        settings: Record of dtype ESTIMATOR_SETTINGS.
    """
    suspects = InputFault(int(record["checks"]["suspects"]))
    texts = {suspect: suspect.text for suspect in InputFault if suspect in suspects}
    if InputFault.TEMPERATURE in texts:
        low_c, high_c = float(settings["filter"]["low_c"]), float(settings["filter"]["high_c"])
        file_range = f"{low_c:.0f} C" if low_c == high_c else f"{low_c:.0f} to {high_c:.0f} C"
        numbers = f"no data at {float(record['filter']['temperature_c']):.0f} C, the cell file knows {file_range}"
        texts[InputFault.TEMPERATURE] = f"{numbers}: {InputFault.TEMPERATURE.text}"
    return list(texts.values())


def contradicts_device(record: np.void, device_soc: float | None, device_std: float | None, *, before: bool) -> bool:
    """Return True if the estimate contradicts the SOC that the device reports, whose std the settings declare.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
        device_soc: SOC by the device, 0..1; None: not reported.
        device_std: Standard deviation of ``device_soc``; None: not declared.
        before: Previous result.
    """
    if device_soc is None or device_std is None or not record["filter"]["started"]:
        return False
    limit = (AGREEMENT_STD if before else CONTRADICTION_STD) * math.hypot(device_std, record["filter"]["soc_std"])
    return bool(abs(record["observer"]["soc"] - device_soc) > limit)


def make_health_payload(
    record: np.void,
    settings: np.void,
    source_counters: Mapping[str, int],
    *,
    now_s: float,
    uptime_s: float,
    loop_lag_s: float,
    restarts: int,
    checkpoint: str,
    sensor_message: str | None,
    delivery: DeliveryStats,
    clock_ppm: float | None,
    total: Totals,
    unseen_s: float | None,
    loop: LoopHealth,
    recording: RecordingHealth | None,
    edge: EdgeHealth | None = None,
    hooks: HookHealth | None = None,
    pack_model: PackModelHealth | None = None,
    contradictions: Sequence[str] = (),
) -> Health:
    """Return the payload of topic ``health``.

    Args:
        record: Record of dtype ESTIMATOR_STATE.
        settings: Record of dtype ESTIMATOR_SETTINGS.
        source_counters: Counters of the source.
        now_s: Wall clock [s since 1970].
        uptime_s: Time since the service started [s].
        loop_lag_s: Longest delay of the event loop since the last report [s].
        restarts: Starts that found files of an earlier run.
        checkpoint: Result of the last attempt to restore or save the checkpoint.
        sensor_message: Reason why no fresh values arrive; None while fresh values arrive.
        delivery: Counters of sent messages and received requests.
        clock_ppm: Drift of the board's clock relative to the host [1e-6]; None if unknown.
        total: Running totals of all runs.
        unseen_s: Length of the last gap without samples [s]; None if there was none or it is unknown.
        loop: Delays of the event loop.
        recording: State of the recording; None: nothing is recorded.
        edge: State of the fleet edge; None without an edge.
        hooks: Successes and failures of alarm hooks; None without hooks.
        pack_model: State of the slow fit; None without a slow fit.
        contradictions: Further texts of ``suspects``: contradictions between the device and settings or estimate.
    """
    state = record["observer"]
    return Health(
        publish_time=iso_utc(now_s),
        uptime_s=uptime_s,
        loop_lag_s=loop_lag_s,
        rss_mib=resident_mib(),
        restarts=restarts,
        reconnects=source_counters.get("reconnects", 0),
        sensor_online=sensor_message is None,
        sensor_message=sensor_message,
        clock_ppm=clock_ppm,
        line={name: int(count) for name, count in source_counters.items() if name != "reconnects"},
        samples=sample_counters(state),
        identifier=identifier_counters(record),
        suspects=[*suspicions(record, settings), *contradictions],
        anchor=last_anchor(record),
        lock_losses=int(state["lock_losses"]),
        gain_rearms=int(state["gain_rearms"]),
        publish_drops=delivery.drops,
        publish_waiting=delivery.waiting,
        store_trouble=delivery.store_trouble() or None,
        broker_losses=delivery.losses,
        broker_trouble=delivery.trouble,
        refused_topics=list(delivery.refused_topics),
        availability_corrections=delivery.corrections,
        requests=dict(delivery.requests),
        checkpoint=checkpoint,
        loop=loop,
        recording=recording,
        edge=edge,
        hooks=hooks,
        pack_model=pack_model,
        unseen_s=unseen_s,
        total=total,
    )


def out_of_range_reason(block: SampleBlock, settings: np.void) -> str | None:
    """Describe the last sample of a block that is out of range or not a number; None without such a sample.

    Args:
        block: Samples, of which some were dropped.
        settings: A record of OBSERVER_SETTINGS.
    """
    low_v, high_v = float(settings["voltage_min_v"]), float(settings["voltage_max_v"])
    max_a = float(settings["current_max_a"])
    voltage_v, current_a = block["voltage_v"], block["current_a"]
    outside = ~((voltage_v >= low_v) & (voltage_v <= high_v) & (np.abs(current_a) <= max_a))
    if not outside.any():
        return None
    volt, ampere = float(voltage_v[outside][-1]), float(current_a[outside][-1])
    missing = [name for name, value in (("voltage", volt), ("current", ampere)) if math.isnan(value)]
    if missing:
        return f"the last of them has no {' and no '.join(missing)}: is the sensor connected?"
    text = (
        f"the last of them {volt:g} V, {ampere:g} A, where {low_v:g}..{high_v:g} V and up to {max_a:g} A are possible"
    )
    # a mistake is suggested if the corrected values are in range
    for question, corrected_v, corrected_a in (
        ("are the columns swapped?", abs(ampere), volt),
        ("are these millivolts?", 1e-3 * volt, ampere),
        ("are these milliamperes?", volt, 1e-3 * ampere),
        ("are these millivolts and milliamperes?", 1e-3 * volt, 1e-3 * ampere),
    ):
        if low_v <= corrected_v <= high_v and abs(corrected_a) <= max_a:
            return f"{text}: {question}"
    min_factor, max_factor = math.ceil(volt / high_v), math.floor(volt / low_v)
    if 1 < min_factor <= min(max_factor, MAX_SERIES_FACTOR) and abs(ampere) <= max_a:
        return f"{text}: are there {min_factor} to {max_factor} times as many cells in series (pack.series)?"
    return text
