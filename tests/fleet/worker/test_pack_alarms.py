"""Alarms of packs in a worker: equal to those of a live run, also over takeovers, and their messages."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from bms_estimator.edge.block import decode, encode
from bms_estimator.fleet.hour_row import Hour
from bms_estimator.fleet.packs.pack_type import LIVE_ALARMS
from bms_estimator.fleet.worker.pack_state import UnpackedRecord
from bms_estimator.fleet.worker.partition import Partition
from bms_estimator.kernels.alarms.records import ALARM, NAMES
from bms_estimator.model.arrays import NO_CELLS, SampleStatus
from bms_estimator.pack.pack import new_pack
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.cells import cell_alarm_inputs
from tests.fleet.worker.test_single_cells import CELLS, MODEL, SETTINGS, minutes, table

PACK = "a"
SEEDS = range(6)
BLOCKS = 24
"""Number of blocks of a minute."""
LATCHING = (
    "pack_over_voltage",
    "cell_over_voltage",
    "discharge_over_current",
    "charge_over_current",
    "charging_below_freezing",
)
"""Alarms that latch by default."""
WITHOUT_LATCH = SETTINGS.model_copy(
    update={"alarms": Settings.model_validate({"alarms": {name: {"latch": False} for name in LATCHING}}).alarms}
)
"""Settings of the live run. No alarm of a worker latches."""
PLAIN_SAMPLES = 2
"""Number of samples at the end of each block without a fault."""


def faulty_minutes(seed):
    """Return blocks with values beyond limits, missing, saturated and impossible values, faulty probes, and gaps."""
    rng, blocks, gap_s = np.random.default_rng(seed), [], 0.0
    for block in minutes(seed, BLOCKS):
        samples, cells_v = block.samples.copy(), block.cells_v.copy()
        samples["temperature_c"] = 25.0
        for _ in range(rng.integers(5)):
            part = slice(int(rng.integers(50)), None if rng.random() < 0.5 else int(rng.integers(50, 58)))
            damage(rng, samples[part], cells_v[part])
        samples[-PLAIN_SAMPLES:], cells_v[-PLAIN_SAMPLES:] = (
            block.samples[-PLAIN_SAMPLES:],
            block.cells_v[-PLAIN_SAMPLES:],
        )
        samples["temperature_c"][-PLAIN_SAMPLES:] = 25.0
        for name in ("temperature_min_c", "temperature_max_c"):
            samples[name] = samples["temperature_c"]
        gap_s += float(rng.choice([0.0, 0.0, 0.0, 45.0]))
        samples["time_s"] += gap_s
        has_cells = rng.random() < 0.9
        arrival_s = block.arrival_s + gap_s
        blocks.append(replace(block, samples=samples, cells_v=cells_v if has_cells else NO_CELLS, arrival_s=arrival_s))
    return blocks


def damage(rng, samples, cells_v):
    """Change samples in place by a fault drawn at random."""
    name, values = FAULTS[rng.integers(len(FAULTS))]
    value = rng.choice(values)
    if name == "cells":
        cells_v *= value
    elif name == "cell":
        cells_v[:, rng.integers(CELLS)] = value
    elif name == "status":
        samples["status"] |= np.uint32(value)
    else:
        samples[name] = value


FAULTS = (
    ("voltage_v", [7.0, 20.0, 150.0, -15.0, 0.2, math.nan]),
    ("current_a", [-40.0, -5.0, 300.0, 1e5, math.nan]),
    ("temperature_c", [70.0, -30.0, -5.0, math.nan]),
    ("cell", [2.0, 4.5, math.nan]),
    ("cells", [1000.0]),
    ("time_s", [math.nan]),
    (
        "status",
        [
            *(SampleStatus.VOLTAGE_SATURATED, SampleStatus.CURRENT_SATURATED),
            *(SampleStatus.PROBE_FAULT, SampleStatus.WRONG_CLOCK),
        ],
    ),
)
"""Field of the samples, or cell voltages, and values."""


class Worker:
    """Partition with one pack, and its results."""

    def __init__(self):
        self.partition, self.results = Partition(0, table, wall=lambda: 0.0), []

    def send(self, block, *, take_over=False):
        """Process a block. Return the states of the alarms by name."""
        self.results.append(self.partition.process(PACK, encode(block), self.partition.sequence + 1))
        if take_over:
            data = b"".join(self.partition.snapshot().chunks())
            self.partition = Partition.restore(0, table, data, wall=lambda: 0.0)
        (states,) = self.partition.state(PACK)["alarms"]["states"]
        return dict(zip(NAMES, states, strict=True))

    @property
    def messages(self):
        """Payloads by topic, oldest first."""
        return [(each.topic, json.loads(each.payload)) for result in self.results for each in result.alarms]


class LiveRun:
    """Pack and alarms as in the service, which evaluates after each block."""

    def __init__(self):
        self.pack, self.seen = new_pack(SETTINGS, MODEL, has_forecasts=False), None
        self.alarms = AlarmEvaluator(WITHOUT_LATCH, self.pack.estimator)

    def send(self, block):
        """Process a block. Return the states of the alarms by name."""
        block = decode(encode(block))
        trace = self.pack.run(block.samples, block.cells_v).trace
        cells = self.pack.cells.deviations
        faults = cell_alarm_inputs(cells) if cells is not None and cells is not self.seen else None
        self.seen = cells
        self.alarms.evaluate(block.samples, trace, block.cells_v, block.arrival_s, cell_alarm_inputs=faults)
        return dict(zip(NAMES, self.alarms._alarms.states, strict=True))


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_alarms_are_those_of_a_live_run(seed):
    worker, live = Worker(), LiveRun()
    for number, block in enumerate(faulty_minutes(seed)):
        states, live_states = worker.send(block), live.send(block)
        for name in states.keys() - LIVE_ALARMS:
            state, expected, context = states[name], live_states[name], (seed, number, name)
            for field in ("raised", "unwatched", "holds"):
                assert state[field] == expected[field], (*context, field)
            assert state["value"] == pytest.approx(expected["value"], nan_ok=True), context
            assert state["since_s"] == pytest.approx(expected["since_s"], abs=1e-3, rel=0.0), context


def test_each_alarm_of_samples_is_raised_and_ends_in_these_blocks():
    worker = [Worker() for _ in SEEDS]
    for seed, each in zip(SEEDS, worker, strict=True):
        for block in faulty_minutes(seed):
            each.send(block)
    payloads = [payload for each in worker for topic, payload in each.messages if topic.startswith("alarm.")]
    for is_active in (True, False):
        names = {payload["name"] for payload in payloads if payload["active"] == is_active}
        assert names >= {*NAMES[:11], "sensor_fault"} - {"stability_margin_low", "weak_cell"}
    assert any(not payload["watched"] for payload in payloads)


def test_takeover_after_each_block_changes_no_state_and_no_message():
    workers = [Worker(), Worker()]
    for block in faulty_minutes(3):
        for worker, take_over in zip(workers, (False, True), strict=True):
            worker.send(block, take_over=take_over)
    first, second = (worker.partition.snapshot() for worker in workers)
    assert first.other_layouts == second.other_layouts
    assert workers[0].messages == workers[1].messages
    assert workers[0].messages


def test_messages_of_a_hot_pack_and_the_row_of_its_hour():
    blocks, worker = minutes(1, 65), Worker()
    for number, block in enumerate(blocks):
        for name in ("temperature_c", "temperature_min_c", "temperature_max_c"):
            block.samples[name] = 70.0 if 2 <= number < 62 else 25.0
        worker.send(block)
    about_heat = [
        (topic, payload)
        for topic, payload in worker.messages
        if payload.get("name") == "over_temperature" or "over_temperature" in payload.get("text", "")
    ]
    raised, alarm, repeated, cleared, ended = about_heat
    assert (raised[0], raised[1]["name"]) == ("event", "alarm_raised")
    assert alarm[0] == "alarm.over_temperature"
    assert (alarm[1]["active"], alarm[1]["value"], alarm[1]["severity"]) == (True, 70.0, "critical")
    assert repeated == alarm  # with the first block of the next hour
    assert (cleared[1]["name"], ended[1]["active"]) == ("alarm_cleared", False)
    ((_, data),) = [hour for result in worker.results for hour in result.hours]
    assert "over_temperature" in Hour.model_validate_json(data).alarms.split()


def test_alarms_of_a_version_with_fewer_of_them_stay_raised():
    position = NAMES.index("over_temperature")
    names = ("raised", "has_value", "holds", "unwatched", "since_s", "value", "held_s", "missing_s")
    states = np.dtype([(name, ALARM[name]) for name in names])
    layout = np.dtype([("alarms", np.dtype([("states", states, (18,)), ("soc_known", "i8")]))])
    before, after = UnpackedRecord(layout), UnpackedRecord()
    before.record["alarms"]["states"]["raised"][0, position] = 1
    before.record["alarms"]["states"]["since_s"][0, position] = 1.7e9
    after.load_previous_layout(layout, before.packed_bytes())
    (alarms,) = after.record["alarms"]["states"]
    assert np.flatnonzero(alarms["raised"]).tolist() == [position]
    assert alarms["since_s"][position] == 1.7e9
