"""Simulated ESPHome node that publishes a JK-BMS by MQTT, for ``source.profile = "esphome-jk"``."""

import asyncio
import random
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Self

from bms_estimator.mqtt.connection import Connection, ConnectOptions, DeliveryStats, Message, brokers
from bms_estimator.mqtt.reconnect_loop import BrokerConnector, ReconnectLoop
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.simulation.virtual_adc import Reading

INTERVAL_S = 2.0
"""Poll interval of the node [s]."""
CELL_STD_V = 0.004
"""Standard deviation of the cell voltages [V]."""


class SimulatedNode:
    """Simulated node that publishes the readings of a pack.

    Args:
        signal: Readings of the pack as a function of time [s].
        cells: Number of cells in series.
        mqtt: Settings of the broker.
        prefix: Name of the node, the first level of its topics.
        speed: Speed relative to real time.
        seed: Seed of the differences between the cells.
        soc: Function that returns the SOC 0..1 that the BMS reports; None: it reports no SOC.
        capacity_ah: Capacity that is configured in the BMS [Ah].

    Raises:
        UserError: The broker's URL cannot be used.
    """

    def __init__(
        self,
        signal: Callable[[float], Reading],
        *,
        cells: int,
        mqtt: MqttSettings,
        prefix: str = "jk-bms",
        speed: float = 1.0,
        seed: int = 0,
        soc: Callable[[], float] | None = None,
        capacity_ah: float = 100.0,
    ) -> None:
        self._signal, self._prefix, self._speed = signal, prefix, speed
        self._soc, self._capacity_ah = soc, capacity_ah
        self._deviations_v = _cell_deviations(cells, random.Random(seed))
        self.path = f"{prefix}/sensor/+/state on {', '.join(mqtt.urls)}"
        """Topics and broker. Messages to the user show them where they show the path of a simulated board's port."""
        self.time_s = 0.0
        """Time of the last reading [s]."""
        self.samples = 0
        self._end_s = 0.0
        will = Message(f"{prefix}/status", b"offline", 1, retain=True)
        # the random part lets several nodes with the same name connect
        client_id = f"{prefix}-{secrets.token_hex(4)}"
        options = ConnectOptions(client_id, will, on_message_lost=lambda *_: None)
        self._reconnect_loop = ReconnectLoop(
            brokers(mqtt), options, BrokerConnector(mqtt), self._serve, DeliveryStats()
        )

    def __enter__(self) -> Self:
        """Return the node. ``run`` connects it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing. ``run`` closes the connection."""

    async def run(self, seconds: float) -> None:
        """Publish for a given simulated time."""
        self._end_s = seconds
        await self._reconnect_loop.run()

    async def _serve(self, connection: Connection) -> None:
        """Publish the readings over an open connection; after a reconnection continue with the next reading."""
        await self._publish(connection, {"status": "online"})
        loop = asyncio.get_running_loop()
        start_s = loop.time() - self.time_s / self._speed  # loop time at which the simulated time is 0
        while self.time_s + INTERVAL_S <= self._end_s:
            await asyncio.sleep(max(start_s + (self.time_s + INTERVAL_S) / self._speed - loop.time(), 0.0))
            self.time_s += INTERVAL_S
            states = {f"sensor/{self._prefix}_{name}/state": text for name, text in self._states()}
            await self._publish(connection, states)
            self.samples += 1
        await self._publish(connection, {"status": "offline"})
        self._reconnect_loop.closing.set()

    async def _publish(self, connection: Connection, states: Mapping[str, str]) -> None:
        for topic, text in states.items():
            await connection.publish(
                Message(f"{self._prefix}/{topic}", text.encode(), 0, retain=True)
            )  # as ESPHome does

    def _states(self) -> Iterator[tuple[str, str]]:
        """Yield name and text of each sensor of the examples of esphome-jk-bms; the current is positive on charge."""
        current_a, voltage_v, temperature_c = self._signal(self.time_s)
        cells_v = [voltage_v / len(self._deviations_v) + deviation_v for deviation_v in self._deviations_v]
        yield "min_cell_voltage", f"{min(cells_v):.3f}"
        yield "max_cell_voltage", f"{max(cells_v):.3f}"
        yield from ((f"cell_voltage_{n}", f"{v:.3f}") for n, v in enumerate(cells_v, start=1))
        yield "total_voltage", f"{voltage_v:.2f}"
        yield "current", f"{-current_a:.2f}"
        yield "power", f"{-current_a * voltage_v:.2f}"
        if self._soc is not None:
            yield "state_of_charge", f"{100.0 * self._soc():.0f}"
            yield "total_battery_capacity_setting", f"{self._capacity_ah:.0f}"
        yield "temperature_sensor_1", f"{temperature_c:.1f}"


def _cell_deviations(cells: int, rng: random.Random) -> Sequence[float]:
    """Return the deviation of each cell from their mean [V]."""
    deviations_v = [rng.gauss(0.0, CELL_STD_V) for _ in range(cells)]
    mean_v = sum(deviations_v) / cells
    return [v - mean_v for v in deviations_v]
