"""Fits of the packs of one partition: rows of their histories, requests for fits, and adoption of the results.

A pack requests a fit when ``SlowFit`` would begin one, and adopts the result ``ADOPT_DELAY_S`` later on the clock of its samples. A
result that arrives later is adopted at the next sample. Results are messages of the partition's stream, so that each worker
adopts them at the same sample.
"""

import math
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import COMPARED, FitRequest, FitResult, Rows, RowsPosition, encode_rows
from bms_estimator.fleet.packs.pack_type import Bytes, PackType, WorkerFit, bytes_of
from bms_estimator.fleet.worker.block_result import QueuedMessage, stored_once
from bms_estimator.fleet.worker.pack_state import PACK_FIT
from bms_estimator.kernels.accumulators.history import MAX_ROWS, MIN_FREE_ROWS
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.pack_model.handover import adopt_curves
from bms_estimator.pack_model.saved import curve_arrays, fit_from_arrays
from bms_estimator.pack_model.slow_fit import ADOPT_DELAY_S, fit_interval

MAX_CACHED_CURVES = 4096
"""Maximum number of packs of a partition whose curves are cached [13 kB each]. Other curves are computed with each block."""
FULL_ROWS = MAX_ROWS - MIN_FREE_ROWS
"""Number of completed rows at which the kernel returns early, so that its caller can take them."""


class PackFits:
    """Fits of the pack whose record is loaded.

    An event, at ``event_s`` of the history, is the request for a fit or the adoption of its result.

    Args:
        record: Unpacked record of the partition, shape (1,), dtype ``PACK_STATE``.
        counters: Counters of the partition; updated.
    """

    def __init__(self, record: NDArray[np.void], counters: Counter[str]) -> None:
        self._fit, self._history = record[0]["fit"], record[0]["estimator"]["history"]
        self._filter = record[0]["estimator"]["filter"]
        self._counters = counters
        self._curves = lru_cache(MAX_CACHED_CURVES)(self._compute_curves)
        self._pack, self._digest, self._sequence = "", (0, 0), 0
        self._messages: list[QueuedMessage] = []

    def use_curves(self, pack: str, pack_type: PackType) -> None:
        """Write the pack's curves in force to the settings of its estimator, which other packs share."""
        fit, settings = self._fit["in_force"], pack_type.cell_file_bytes
        if sequence := int(fit["sequence"]):
            settings = self._curves(pack, pack_type, sequence, float(fit["elapsed_s"]))
        pack_type.filter_bytes[...] = settings

    def _compute_curves(self, _pack: str, pack_type: PackType, *_fit: float) -> Bytes:
        """Return the settings of the filter with the curves of the fit in force. The other arguments identify the fit."""
        settings = pack_type.estimator.cell_file_settings.copy()
        adopt_curves(settings, pack_type.estimator.cell_file_settings, fit_of_record(self._fit["in_force"]))
        return bytes_of(settings)

    def begin_block(self, pack: str, pack_type: PackType, sequence: int) -> None:
        """Begin a block of the loaded pack.

        Args:
            pack: Name of the pack.
            pack_type: Type of the pack.
            sequence: Stream sequence number of the block.
        """
        if isinstance(slow_fit := pack_type.pack.slow_fit, WorkerFit) and slow_fit.bank:
            slow_fit.bank.weakest = weakest_of_record(self._fit)
        self._pack, self._digest, self._sequence, self._messages = pack, pack_type.state_digest, sequence, []
        if pack_type.pack.slow_fit and not self._history["enabled"]:
            pack_type.estimator.schedule(self._history["elapsed_s"] + pack_type.pack.slow_fit.interval())

    def curves_in_force(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the fit in force (``PackState.curves``); empty without one."""
        fit = self._fit["in_force"]
        return curve_arrays(fit_of_record(fit) if fit["sequence"] else None)

    def restart(self, pack_type: PackType) -> None:
        """Drop a request, because the pack's settings have changed. The next block begins a new interval between fits.

        Without fits, the curves are those of the cell file.
        """
        self._fit["request"], self._fit["received"], self._history["enabled"] = 0, np.zeros((), PACK_FIT), 0
        if pack_type.pack.slow_fit is None:
            self._fit["in_force"] = np.zeros((), PACK_FIT)

    def advance(self, slow_fit: WorkerFit) -> None:
        """Send completed rows, and request or adopt a fit that is due."""
        history = self._history
        if history["elapsed_s"] >= history["event_s"]:
            self._handle_event(slow_fit)
        elif history["count"] >= FULL_ROWS:
            self._send_rows(slow_fit)

    def take_messages(self) -> tuple[QueuedMessage, ...]:
        """Return the messages of the block."""
        return tuple(self._messages)

    def receive(self, result: FitResult, sequence: int, pack_type: PackType) -> bool:
        """Process the result of a fit. Return True if the loaded pack has requested it.

        Args:
            result: The result.
            sequence: Stream sequence number of its message.
            pack_type: Type of the pack.
        """
        fit, history, slow_fit = self._fit, self._history, pack_type.pack.slow_fit
        if not isinstance(slow_fit, WorkerFit) or fit["request"] != result.request:
            return False
        if not result.is_fitted:
            fit["request"] = 0
            begun_s = float(fit["begun_s"])
            slow_fit.estimator.schedule(begun_s + fit_interval(begun_s, slow_fit.interval_s))
            return True
        write_fit(fit["received"], result, sequence)
        write_weakest(fit, result)
        if history["event_s"] > fit["begun_s"] + ADOPT_DELAY_S:
            slow_fit.estimator.schedule(history["elapsed_s"])  # a late result is adopted at the next sample
        return True

    def _handle_event(self, slow_fit: WorkerFit) -> None:
        """Adopt the received fit; or request a fit, unless an unanswered request is younger than the interval between fits."""
        fit, history = self._fit, self._history
        due_s = fit["begun_s"] + ADOPT_DELAY_S
        if fit["received"]["sequence"]:
            self._adopt(slow_fit)
            fit["request"], fit["received"] = 0, np.zeros((), PACK_FIT)
            # an interval after the request, summed in the order of SlowFit, so that both schedule an equal number
            slow_fit.estimator.schedule(due_s + (slow_fit.interval() - ADOPT_DELAY_S))
        elif (
            fit["request"] and history["event_s"] == due_s
        ):  # the adoption was scheduled with this sum, so that it is equal
            self._counters["late_fits"] += 1
            slow_fit.estimator.schedule(due_s + slow_fit.interval())
        else:
            self._send_rows(slow_fit, is_request=True)
            fit["request"], fit["begun_s"] = self._sequence, history["elapsed_s"]
            slow_fit.estimator.schedule(history["elapsed_s"] + ADOPT_DELAY_S)

    def _adopt(self, slow_fit: WorkerFit) -> None:
        """Adopt the received fit, unless the filter's SOC is more certain. After an error, the previous fit stays in force."""
        received, estimator = self._fit["received"], slow_fit.estimator
        if not received["min_filter_std"] <= self._filter["soc_std"]:
            return
        before = estimator.record.copy(), estimator.settings_record.copy()
        try:
            slow_fit.adopt(fit_of_record(received))
        except Exception:  # noqa: BLE001 - a failed fit must not end the estimates of the pack
            estimator.load_exact(*before)
            self._counters["failed_fits"] += 1
        else:
            self._fit["in_force"] = received
            self._counters["fits"] += 1

    def _send_rows(self, slow_fit: WorkerFit, *, is_request: bool = False) -> None:
        """Send the completed rows; with ``is_request``, also request a fit of all rows so far."""
        rows = slow_fit.estimator.take_rows()
        position, identity = RowsPosition(self._sequence, len(self._messages)), f"{self._pack}.{self._sequence}"
        data = encode_rows(Rows(rows, position, self._digest))
        self._messages.append(stored_once(subjects.history(self._pack), data, f"{identity}.{position.part}"))
        if is_request:
            request = FitRequest(sequence=self._sequence, part=position.part).model_dump_json().encode()
            self._messages.append(stored_once(subjects.fit_request(self._pack), request, identity))


def write_fit(record: np.void, result: FitResult, sequence: int) -> None:
    """Write the result of a fit to a record of dtype ``PACK_FIT``. A failed fit is never adopted."""
    record["sequence"] = sequence
    record["min_filter_std"] = math.inf if result.fit is None else result.min_filter_std
    for name, value in curve_arrays(result.fit).items():
        record[name] = value
    record["is_exchanged"] = result.fit is not None and result.fit.is_exchanged


def write_weakest(record: np.void, result: FitResult) -> None:
    """Write the weakest cell of a bank to a record of dtype ``FIT``. If the bank was exchanged, the stored cell is dropped."""
    if result.weakest is not None:
        record["has_weakest"] = 1
        for name, value in vars(result.weakest).items():
            record["weakest"][name] = value
    elif result.fit is not None and result.fit.is_exchanged:
        record["has_weakest"] = 0


def weakest_of_record(record: np.void) -> ComparedCell | None:
    """Return the weakest cell in a record of dtype ``FIT``; None if it is unknown."""
    return ComparedCell(*(record["weakest"][name] for name in COMPARED.names or ())) if record["has_weakest"] else None


def fit_of_record(record: np.void) -> PackFit:
    """Return the fit in a record of dtype ``PACK_FIT``."""
    arrays: dict[str, NDArray[Any]] = {name: np.asarray(record[name]) for name in PACK_FIT.names or ()}
    fit = fit_from_arrays(arrays)
    assert fit is not None  # noqa: S101 - for the type checker: there are arrays
    return replace(fit, is_exchanged=bool(record["is_exchanged"]))
