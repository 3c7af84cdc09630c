"""Handlers of the requests that clients send over MQTT, and the forecast under a load that a client gives."""

import asyncio
import math
import reprlib
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import structlog

from bms_estimator.forecast.available_power import Forecast
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.trip import (
    MAX_LOAD,
    MAX_TRIP_S,
    LoadQuantity,
    Trip,
    TripOutcome,
    constant_trip,
    profile_trip,
    trip_outcome,
)
from bms_estimator.model.errors import UserError
from bms_estimator.pack.pack import Pack
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import MAX_RATE_HZ, MIN_RATE_HZ
from bms_estimator.sinks.mqtt.requests import RequestDispatcher, number

CONSTANT_LOADS: tuple[LoadQuantity, ...] = ("power_w", "current_a")
"""Arguments that give a constant load, named after its quantity."""
PROFILE_LOADS: dict[str, LoadQuantity] = {"profile": "power_w", "current_profile": "current_a"}
"""Arguments that give a profile, each with the quantity of its load."""
MAX_NUMBER = 1e15
"""Maximum absolute value of a number in a profile. Python parses JSON integers of any size, also those too large for a float."""
DURATION = "duration_s"
"""Argument that gives the duration of a constant load."""
FIELDS = (
    "time_to_cutoff_s",
    "time_to_cutoff_p05_s",
    "time_to_cutoff_p95_s",
    "cutoff_within_2min",
    "cutoff_within_5min",
    "cutoff_within_15min",
    "usable_capacity_ah",
)
"""Fields of FORECAST that depend on the load."""


def requested_trip(arguments: Mapping[str, Any]) -> Trip | None:
    """Return the trip of a request; None if it gives no load.

    Args:
        arguments: Arguments of the request: ``power_w`` or ``current_a``, and optionally ``duration_s``; or ``profile`` or
            ``current_profile``, a list of pairs of time [s] and power [W] or current [A].

    Raises:
        UserError: An argument is invalid, or more than one load is given.
    """
    names = [name for name in (*CONSTANT_LOADS, *PROFILE_LOADS) if name in arguments]
    if len(names) > 1:
        raise UserError(f"{' and '.join(names)}: give one of them")
    if not names or names[0] in PROFILE_LOADS:
        if DURATION in arguments:
            raise UserError(f"{DURATION}: belongs to {' or '.join(CONSTANT_LOADS)}")
        return _profile(names[0], arguments[names[0]]) if names else None
    duration_s = number(arguments, DURATION, 0.0, MAX_TRIP_S) if DURATION in arguments else None
    quantity: LoadQuantity = "power_w" if names[0] == "power_w" else "current_a"
    return constant_trip(quantity, number(arguments, quantity, -MAX_LOAD, MAX_LOAD), duration_s)


def _profile(name: str, points: Any) -> Trip:
    """Return the trip of a list of pairs.

    Raises:
        UserError: ``points`` is not a list of pairs, or ``profile_trip`` rejects it.
    """
    quantity = PROFILE_LOADS[name]
    if not isinstance(points, list) or not all(_is_pair(point) for point in points):
        raise UserError(f"{name}: must be a list of pairs [time_s, {quantity}]")
    pairs = np.array(points, dtype=float).reshape(-1, 2)
    try:
        return profile_trip(quantity, pairs[:, 0], pairs[:, 1])
    except UserError as error:
        raise UserError(f"{name}: {error}") from None


def _is_pair(point: Any) -> bool:
    return (
        isinstance(point, list)
        and len(point) == 2
        and all(isinstance(value, int | float) and abs(value) <= MAX_NUMBER for value in point)
    )


async def forecast_in_thread(forecaster: Forecaster, trip: Trip | None) -> dict[str, Any]:
    """Compute a forecast from the present state in a thread, so that the event loop reads samples meanwhile."""
    return await asyncio.to_thread(forecast_data, forecaster.copy(), trip)


def forecast_data(forecaster: Forecaster, trip: Trip | None) -> dict[str, Any]:
    """Return a forecast from the present state as data for JSON; unknown values are None.

    Args:
        forecaster: Forecaster of the pack.
        trip: Expected trip; None: a load like the observed one.
    """
    forecast = forecaster.forecast(trip.load if trip else None)
    curve = forecaster.given_load_curve(trip.load) if trip and trip.has_end else None
    return as_json_data(forecast, trip_outcome(trip, curve) if trip and curve else None, forecaster.cutoff_v)


def as_json_data(forecast: Forecast, outcome: TripOutcome | None, cutoff_v: float) -> dict[str, Any]:
    """Return a forecast as data for JSON; unknown values are None.

    Args:
        forecast: The forecast.
        outcome: Outcome of the trip; None without a trip, and for a trip without an end.
        cutoff_v: Voltage at which the load is switched off [V].
    """
    values = {name: _finite_or_none(float(forecast.values[0][name])) for name in FIELDS}
    trip = {name: _finite_or_none(value) for name, value in asdict(outcome).items()} if outcome else None
    return {**values, "cutoff_v": cutoff_v, "reason": forecast.reason, "trip": trip}


def _finite_or_none(value: Any) -> Any:
    """Return None for NaN and infinity; another value unchanged."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
