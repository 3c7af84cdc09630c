"""States of many packs as workers publish them. Values are distributed realistically and depend only on a seed."""

from typing import Any, NamedTuple

import numpy as np
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.packs.pack_bucket import write_bucket
from bms_estimator.fleet.packs.pack_row import PackSpec, encode_row
from tests.sinks.snapshots import CELL_SNAPSHOT

HOME, VAN, PLANT = (
    PackSpec(cell="lfp", capacity_ah=280.0, series=16),
    PackSpec(cell="ncr18650", series=14, parallel=10),
    PackSpec(cell="nmc", capacity_ah=50.0, series=96),
)
KINDS = {"home": (HOME, 0.7), "van": (VAN, 0.25), "plant": (PLANT, 0.05)}
"""Kinds of packs by the beginning of their names, and their fractions of all packs."""
MEASURED_VALUES = {
    "home": {
        "voltage_v": 52.81,
        "voltage_estimate_v": 52.814,
        "current_a": -31.2,
        "power_w": -1647.7,
        "temperature_c": 21.5,
    },
    "van": {
        "voltage_v": 51.93,
        "voltage_estimate_v": 51.928,
        "current_a": 4.6,
        "power_w": 238.9,
        "temperature_c": 12.1,
    },
    "plant": {
        "voltage_v": 354.2,
        "voltage_estimate_v": 354.19,
        "current_a": 12.4,
        "power_w": 4392.1,
        "temperature_c": 24.8,
    },
}
_PLACEHOLDER = 0.123456789012345
"""Value that is replaced in the encoded state of a kind, so that a state is encoded only once for each kind."""


class Pack(NamedTuple):
    """Pack with its published state."""

    name: str
    kind: PackSpec
    state: bytes


def state(**values: Any) -> bytes:
    """Return an encoded state with these values, and otherwise those of an example."""
    assert CELL_SNAPSHOT.estimate
    return CELL_SNAPSHOT.estimate.model_copy(update=values).model_dump_json().encode()


def make_packs(count: int, seed: int = 1) -> list[Pack]:
    """Return ``count`` packs with their states."""
    rng = np.random.default_rng(seed)
    names = rng.choice(list(KINDS), count, p=[share for _, share in KINDS.values()])
    soc = np.where(names == "plant", rng.beta(9, 7, count), rng.beta(3.2, 1.9, count))
    std = rng.lognormal(np.where(names == "home", -4.1, -4.6), 0.45)
    soc_minus_margin = rng.uniform(0.01, 0.09, count)
    placeholders = {"soc": _PLACEHOLDER, "soc_std": _PLACEHOLDER + 1.0, "stability_margin": _PLACEHOLDER + 2.0}
    parts = {name: _split_at(state(**placeholders, **MEASURED_VALUES[name]), *placeholders.values()) for name in KINDS}
    packs = []
    for i, name in enumerate(names):
        begin, after_soc, after_std, end = parts[name]
        values = (f"{soc[i]:.6f}", f"{std[i]:.6f}", f"{soc[i] - soc_minus_margin[i]:.6f}")
        data = begin + values[0].encode() + after_soc + values[1].encode() + after_std + values[2].encode() + end
        packs.append(Pack(f"{name}-{i:06d}", KINDS[name][0], data))
    return packs


def _split_at(data: bytes, *placeholders: float) -> list[bytes]:
    """Return the bytes before, between and after the placeholders."""
    parts = []
    for placeholder in placeholders:
        before, _, data = data.partition(str(placeholder).encode())
        parts.append(before)
    return [*parts, data]


async def publish(nc: Client, pack: str, data: bytes) -> None:
    """Publish a pack's state."""
    await nc.publish(subjects.published(pack, "state"), data)


async def publish_heartbeat(nc: Client, worker: str, partitions: range, **values: Any) -> None:
    """Publish a worker's heartbeat."""
    heartbeat = Heartbeat(id=worker, started_s=0.0, partitions=tuple(partitions), **values)
    await nc.publish(subjects.worker(worker), heartbeat.model_dump_json().encode())


async def load(nc: Client, packs: list[Pack]) -> None:
    """Write the rows of the packs to the table of packs."""
    rows = {kind: encode_row(kind) for kind in (HOME, VAN, PLANT)}
    await write_bucket(nc, subjects.PACKS_BUCKET, {pack.name: rows[pack.kind] for pack in packs})
