"""Handlers of the requests to a running service."""

import reprlib
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.pack.pack import Pack
from bms_estimator.service.forecast_request import forecast_in_thread, requested_trip
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import MAX_RATE_HZ, MIN_RATE_HZ
from bms_estimator.sinks.mqtt.requests import RequestDispatcher, number

log = structlog.get_logger(__name__)


class RequestHandlers:
    """Handlers of the requests of one pack; each method is named after its request.

    Args:
        pack: The pack.
        publisher: Publisher of the pack.
        store_current_zero: Makes the board store the present current as zero; None: the source has no such command.
    """

    def __init__(
        self, pack: Pack, publisher: Publisher, store_current_zero: Callable[[], Awaitable[None]] | None
    ) -> None:
        self._pack, self._estimator, self._publisher, self._store_current_zero = (
            pack,
            pack.estimator,
            publisher,
            store_current_zero,
        )

    def register(self, requests: RequestDispatcher) -> None:
        """Register all handlers."""
        for handler in (
            self.set_soc,
            self.current_zero,
            self.publish_rate,
            self.acknowledge_alarm,
            self.forget_pack,
            self.forecast,
        ):
            requests.register(handler.__name__, handler)

    async def set_soc(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Set the SOC.

        Raises:
            UserError: An argument is invalid, or there is no SOC to set.
        """
        soc = number(arguments, "soc", 0.0, 1.0)
        if not self._estimator.state["started"][0]:
            raise UserError("no sample has been taken yet")
        before = float(self._estimator.state["soc"][0])
        try:
            self._estimator.set_soc(soc)
        except ValueError as error:
            raise UserError(str(error)) from None
        log.info("SOC set on request", before=before, soc=soc)
        return {"soc": soc, "before": before}

    async def current_zero(self, _: Mapping[str, Any]) -> Mapping[str, Any]:
        """Make the board store the present current as zero.

        Raises:
            UserError: The pack is not at rest, or the source has no such command.
        """
        if self._store_current_zero is None:
            raise UserError("this source has no zero to be set")
        if self._publisher.not_at_rest_reason:
            raise UserError(self._publisher.not_at_rest_reason)
        await self._store_current_zero()
        log.info("present current taken as zero on request")
        return {}

    async def publish_rate(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Set the publish rate until the next start.

        Raises:
            UserError: The rate is missing or out of range.
        """
        rate_hz, before = number(arguments, "rate_hz", MIN_RATE_HZ, MAX_RATE_HZ), 1.0 / self._publisher.period_s
        self._publisher.set_rate(rate_hz)
        log.info("publish rate set on request", before=before, rate_hz=rate_hz)
        return {"rate_hz": rate_hz, "before": before}

    async def acknowledge_alarm(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Acknowledge the alarm ``name``, or all alarms.

        Raises:
            UserError: There is no such alarm, or the service is stopping.
        """
        name, alarm_names = arguments.get("name"), self._publisher.alarm_monitor.alarms.names()
        if name is not None and name not in alarm_names:
            raise UserError(
                f"name = {reprlib.repr(name)}: must be one of {', '.join(alarm_names)}, or left out for all"
            )
        acknowledged = self._publisher.alarm_monitor.acknowledge(name)
        log.info("alarms acknowledged on request", alarms=acknowledged)
        return {"acknowledged": acknowledged}

    async def forget_pack(self, _: Mapping[str, Any]) -> Mapping[str, Any]:
        """Discard everything learned from the pack, because it was exchanged for a new one.

        Raises:
            UserError: The service fits no model of the pack, or no sample has been taken yet.
        """
        if self._pack.slow_fit is None:
            raise UserError("nothing is learned from this pack: identifier.pack_model or identifier.enabled is false")
        if not self._estimator.state["started"][0]:
            raise UserError("no sample has been taken yet")
        rows = int(self._pack.slow_fit.history.rows.size)
        self._pack.slow_fit.forget()
        log.info("history and model of the pack discarded on request", rows=rows)
        return {"rows": rows}

    async def forecast(self, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a forecast from the present state, under the load of the request or a load like the observed one.

        Raises:
            UserError: An argument is invalid, or there are no forecasts for this pack.
        """
        if self._pack.forecaster is None:
            raise UserError("there are no forecasts for a fuel cell, or with identifier.enabled = false")
        return await forecast_in_thread(self._pack.forecaster, requested_trip(arguments))
