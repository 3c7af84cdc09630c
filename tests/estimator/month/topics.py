"""Voltage and current on separate MQTT topics, paired by the code of the service."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bms_estimator.model.arrays import SampleBlock
from bms_estimator.protocols.devices.text import TextProtocol
from bms_estimator.settings.sources.mqtt import MqttSource
from bms_estimator.sources.mqtt.sample_assembler import SampleAssembler

VOLTAGE, CURRENT = "pack/voltage", "pack/current"
"""Topics of the publisher."""


@dataclass(frozen=True)
class Topics:
    """Times at which a publisher measures and sends voltage and current."""

    voltage_period_s: float = 10.0
    current_period_s: float = 10.0
    current_shift_s: float = 0.0
    """Time from the measurement of a voltage to that of the next current [s]."""
    current_delay_s: float = 0.1
    """Time from the measurement of a current to its arrival [s]. A voltage arrives at once."""
    dead_band_v: float = 0.0
    """Minimum change of the voltage that is sent [V]; 0: each voltage is sent."""
    dead_band_a: float = 0.0
    """Minimum change of the current that is sent [A]; 0: each current is sent."""
    max_silent_s: float = 600.0
    """Time after which a value within its dead band is sent [s]."""
    interval_s: float = 10.0
    """Sample period that the owner configures [s]."""


Message = tuple[float, str, float]
"""Arrival time [s], topic and value."""


def paired(topics: Topics, samples: SampleBlock) -> SampleBlock:
    """Return the samples that the service makes of the messages of a publisher that measures ``samples`` at 1 Hz."""
    assembler = SampleAssembler(
        MqttSource.model_validate(
            {
                "kind": "mqtt",
                "voltage": {"topic": VOLTAGE},
                "current": {"topic": CURRENT},
                "interval_s": topics.interval_s,
                "max_silent_s": topics.max_silent_s if topics.dead_band_a else None,
            }
        )
    )
    decoder = TextProtocol()
    arrivals = list(lines(assembler, messages(topics, samples)))
    block: SampleBlock = np.concatenate([decoder.feed(now_s, line) for now_s, line in arrivals])
    block["time_s"] += arrivals[0][0] - block["time_s"][0]
    block["temperature_c"] = samples["temperature_c"][0]
    return block


def lines(assembler: SampleAssembler, arrivals: list[Message]) -> Iterator[tuple[float, bytes]]:
    """Yield time and line of each sample, as the loop of the service does."""
    now_s = 0.0
    for arrival_s, topic, value in arrivals:
        while (wait_s := assembler.wait_s(now_s)) is not None and now_s + wait_s < arrival_s:
            now_s += max(wait_s, 1e-6)
            if line := assembler.line(now_s):
                yield now_s, line
        now_s = arrival_s
        assembler.add_message(topic, b"%.6f" % value, now_s, retained=False)
        if line := assembler.line(now_s):
            yield now_s, line


def messages(topics: Topics, samples: SampleBlock) -> list[Message]:
    """Return the messages in order of arrival."""
    voltages = published(samples, "voltage_v", topics.voltage_period_s, 0.0, topics.dead_band_v, topics.max_silent_s)
    currents = published(
        samples, "current_a", topics.current_period_s, topics.current_shift_s, topics.dead_band_a, topics.max_silent_s
    )
    return sorted(
        [(time_s, VOLTAGE, value) for time_s, value in voltages]
        + [(time_s + topics.current_delay_s, CURRENT, value) for time_s, value in currents]
    )


def published(
    samples: SampleBlock, name: str, period_s: float, shift_s: float, dead_band: float, max_silent_s: float
) -> list[tuple[float, float]]:
    """Return the times and values at which one quantity is sent."""
    chosen = samples[round(shift_s) :: round(period_s)]
    times_s, values = chosen["time_s"].tolist(), chosen[name].tolist()
    if not dead_band:
        return list(zip(times_s, values, strict=True))
    sent = [(times_s[0], values[0])]
    for time_s, value in zip(times_s, values, strict=True):
        if abs(value - sent[-1][1]) >= dead_band or time_s - sent[-1][0] >= max_silent_s:
            sent.append((time_s, value))
    return sent
