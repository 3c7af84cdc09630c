"""Process that fits the models of packs to their histories, at the requests of workers.

The process has no state of its own, so that several processes can share the requests, which wait in the stream ``FITS``. The
stream ``HISTORY`` has the history of a pack up to its last fit as one message, and later rows.
"""

import asyncio
import multiprocessing
import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import nats.js.errors
import numpy as np
import structlog
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.js import JetStreamContext
from nats.js.api import ConsumerConfig, Header
from nats.js.kv import MSG_ROLLUP_SUBJECT
from pydantic import ValidationError

from bms_estimator.edge import subjects
from bms_estimator.fleet.fits.messages import FitRequest
from bms_estimator.fleet.fits.pack_history import FitAnswer, FitJob, run_job
from bms_estimator.fleet.nats.connection import RETRYABLE_ERRORS, connect, error_text, run_connected
from bms_estimator.fleet.nats.stream_reader import read_stream
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.packs.pack_type import type_estimator
from bms_estimator.model.errors import TemporaryError
from bms_estimator.process.child_process import request_sigterm_on_exit_of
from bms_estimator.process.runtime import until_first_ends
from bms_estimator.process.systemd import SystemdNotifier

NAME = "fit"
"""Name of the process, for systemd and the server, and of the durable consumer."""
FETCH_S = 1.0
"""Timeout of a fetch from the stream ``FITS`` [s]."""
ACK_S = 300.0
"""Time after which the server delivers an unanswered request again [s]. A fit to the longest history takes 4 s."""
RETRY_S = 5.0
"""Retry interval after an error, or while rows are not stored yet [s]."""
MAX_DELIVERIES = 5
"""Maximum number of deliveries of a request, because a fit may kill the process. The worker sends another request after the
interval between two fits."""
STATUS_S = 60.0
"""Interval between two log lines with the counters [s]."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Options:
    """Options of the process.

    Attributes:
        servers, creds, ca: Arguments of ``connect``.
        processes: Number of fits that run in parallel.
    """

    servers: str
    creds: Path | None = None
    ca: Path | None = None
    processes: int = 1


async def fit_packs(options: Options, stop: asyncio.Event) -> None:
    """Answer requests for fits until ``stop`` is set.

    Raises:
        UserError: An option cannot be used, or the server has closed the connection permanently.
    """

    async def run(nc: Client) -> None:
        await until_first_ends(Fitter(nc, options).run(), stop.wait())

    await run_connected(run, stop, connect(options.servers, NAME, creds=options.creds, ca=options.ca))


class Fitter:
    """Loop that answers requests for fits.

    Args:
        nc: Connection to the tenant's NATS account, which reconnects.
        options: Options of the process.

    Attributes:
        counters: Numbers of ``fits``, of ``dropped`` requests, of histories with ``damaged`` rows, and of ``faults`` of the server.
    """

    def __init__(self, nc: Client, options: Options) -> None:
        self._nc, self._options, self._bucket = nc, options, PackBucket(nc)
        self._pool: ProcessPoolExecutor | None = None
        self._notifier = SystemdNotifier([NAME], activity="fitting")
        self.counters = Counter[str]()

    async def run(self) -> None:
        """Answer requests until cancelled.

        Raises:
            TemporaryError: The server has closed the connection permanently.
        """
        try:
            await until_first_ends(self._answer_all(), self._bucket.follow(lambda _: None), self._log_status())
        finally:
            self._notifier.stopping(NAME)
            if self._pool:
                self._pool.shutdown(wait=False, cancel_futures=True)

    async def _answer_all(self) -> None:
        subscription: JetStreamContext.PullSubscription | None = None
        while True:
            self._notifier.alive(NAME)
            try:
                subscription = subscription or await self._subscribe()
                messages = await self._fetch(subscription)
                await asyncio.gather(*map(self._answer, messages))
            except RETRYABLE_ERRORS as error:
                if self._nc.is_closed:
                    raise TemporaryError("the server has closed the connection: check --creds") from None
                subscription = None
                self.counters["faults"] += 1
                log.warning("fits wait for the server", reason=error_text(error), again_in_s=RETRY_S)
                await asyncio.sleep(RETRY_S)

    async def _subscribe(self) -> JetStreamContext.PullSubscription:
        await self._bucket.refresh()
        js = self._nc.jetstream()
        await js.add_consumer(subjects.FITS_STREAM, ConsumerConfig(durable_name=NAME, ack_wait=ACK_S))
        subscription = await js.pull_subscribe_bind(NAME, subjects.FITS_STREAM)
        self._notifier.ready(NAME)
        log.info("ready", processes=self._options.processes)
        return subscription

    async def _fetch(self, subscription: JetStreamContext.PullSubscription) -> Sequence[Msg]:
        try:
            return await subscription.fetch(self._options.processes, timeout=FETCH_S)
        except TimeoutError:
            return ()

    async def _answer(self, message: Msg) -> None:
        """Answer one request, or let the server deliver it again if rows are missing or were added meanwhile."""
        pack = message.subject.split(".")[1]
        if message.metadata.num_delivered > MAX_DELIVERIES or not (job_data := self._parse(pack, message.data)):
            self.counters["dropped"] += 1
            await message.term()
            return
        request, settings = job_data
        stored = [
            stored
            async for batch in read_stream(self._nc, subjects.HISTORY_STREAM, subjects.history(pack))
            for stored in batch
        ]
        answer = await self._run(FitJob(request, settings, [each.data for each in stored]))
        last_sequence = stored[-1].sequence if stored else 0
        if answer is None or not await self._send(pack, request, answer, last_sequence):
            await message.nak(RETRY_S)
            return
        self.counters["fits"] += answer.result is not None
        if answer.error:
            self.counters["damaged"] += 1
            log.warning("rows of a history are skipped", pack=pack, reason=answer.error)
        await message.ack()

    def _parse(self, pack: str, data: bytes) -> tuple[FitRequest, np.ndarray] | None:
        """Return a request and the settings of its pack; None if the request is damaged or the pack is unknown."""
        try:
            request, settings_and_model = FitRequest.model_validate_json(data), self._bucket.packs(pack)
        except ValidationError:
            return None
        return settings_and_model and (request, np.array([type_estimator(*settings_and_model).cell_file_settings]))

    async def _run(self, job: FitJob) -> FitAnswer | None:
        """Run a fit in another process. Return None if rows are missing, or if the process has died."""
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(
                self._options.processes, context, initializer=request_sigterm_on_exit_of, initargs=(os.getpid(),)
            )
        try:
            return await asyncio.get_running_loop().run_in_executor(self._pool, run_job, job)
        except BrokenProcessPool:
            log.warning("a process that fits was killed, perhaps for lack of memory: reduce --processes")
            self._pool = None
            return None

    async def _send(self, pack: str, request: FitRequest, answer: FitAnswer, last_sequence: int) -> bool:
        """Send the result to the worker, and replace the messages of the history. Return False if the history has new messages."""
        js, identity = self._nc.jetstream(), f"{pack}.{request.sequence}"
        if answer.result is not None:
            await js.publish(subjects.fit(pack), answer.result, headers={Header.MSG_ID.value: f"{identity}.fit"})
        headers = {
            Header.ROLLUP.value: MSG_ROLLUP_SUBJECT,
            Header.EXPECTED_LAST_SUBJECT_SEQUENCE.value: str(last_sequence),
        }
        try:
            await js.publish(subjects.history(pack), answer.history, headers=headers)
        except nats.js.errors.BadRequestError:
            return False
        return True

    async def _log_status(self) -> None:
        while True:
            await asyncio.sleep(STATUS_S)
            log.info("fits", **self.counters)
