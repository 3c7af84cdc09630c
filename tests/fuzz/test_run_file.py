"""Restore of counters and alarms from an edited ``<pack.name>.run``. An exception would end the service at each start."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, strategies as st

from bms_estimator.checkpoint.run_file import add_checksum
from bms_estimator.checkpoint.state_files import StateFiles
from bms_estimator.estimator.estimator import compiled_estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.cell_slots import CellSlots
from bms_estimator.model.clock import Clock
from bms_estimator.pack.pack import Pack
from bms_estimator.service.alarm_monitor import AlarmMonitor
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.publish_window import LifetimeTotals
from tests.fuzz.edited_seeds import edit
from tests.scripted_source import ScriptedSource

SETTINGS = Settings.model_validate({"pack": {"cell": "ncr18650"}})
CELL = load_cell("ncr18650")
ESTIMATOR = compiled_estimator(SETTINGS, CELL)
RAISED = {"since_s": 1.7e9, "value": 4.4, "gone": True, "acknowledged": False, "severity": "critical"}
ALARMS = {
    "pack_over_voltage": RAISED,
    "soc_low": RAISED | {"value": None, "gone": False, "severity": "warning"},
    "link_lost": RAISED | {"acknowledged": True},
    "inputs": {"temperature": [1, True], "cells": [1, False]},
    "silence": "no frame yet",
}
COUNTERS = {
    "format": 1,
    "restarts": 3,
    "total": {
        "since": "2026-01-01T00:00:00.000Z",
        "crashes": 1,
        "samples": {"samples": 1000, "dropped_gap": 2},
        "unseen_s": 5.0,
        "charge_out_ah": 1.0,
        "charge_in_ah": 2.0,
    },
    "clean": True,
    "cell_slots": [0, 1, 5],
}


def encode(alarms: str) -> bytes:
    """Return the content of the file, without its checksum."""
    return json.dumps(COUNTERS | {"alarms": alarms}).encode()


SEED = json.dumps(ALARMS)
HALF_CHARACTER = b"\\ud800"
"""Half of a character outside the basic multilingual plane, in JSON. It cannot be encoded in UTF-8."""
ODD_ALARMS = edit([SEED.encode()], (HALF_CHARACTER,)).map(lambda text: encode(text.decode(errors="replace")))
BODIES = edit([encode(SEED)], (HALF_CHARACTER,)) | ODD_ALARMS
FILE = add_checksum(encode(SEED))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the state folder of all inputs."""
    return tmp_path_factory.mktemp("state")


def restore(folder: Path, content: bytes) -> set[str]:
    """Restore from a file as the service does, and encode what it publishes. Return the names of the raised alarms."""
    files, clock = StateFiles(folder, SETTINGS, CELL), Clock()
    files.run_file.path.write_bytes(content)
    saved = files.read_counters()
    assert len(CellSlots(3, saved.counters.cell_slots).select(np.full((2, 6), 3.7))) == 2
    monitor = AlarmMonitor(SETTINGS, Pack(ESTIMATOR), ScriptedSource(), clock, lambda _: None)
    if reason := saved.lost_reason or monitor.restore(saved.counters.alarms):
        monitor.raise_state_lost(reason)
    monitor.evaluate(clock.monotonic())
    assert LifetimeTotals(ESTIMATOR, saved.counters.total).total.model_dump_json()
    for alarm in monitor.report:
        assert alarm.model_dump_json()
    return {alarm.name for alarm in monitor.report if alarm.active}


def test_an_unedited_file_restores_its_alarms(folder: Path) -> None:
    raised = restore(folder, FILE)
    assert "pack_over_voltage" in raised
    assert "alarm_state_lost" not in raised


@example(add_checksum(encode(json.dumps({"\ud800": RAISED}))))
@given(BODIES.map(add_checksum))
def test_odd_content_with_a_checksum_ends_no_start(folder: Path, content: bytes) -> None:
    restore(folder, content)


@given(edit([FILE], ()).filter(lambda content: content != FILE) | st.binary(max_size=64))
def test_damaged_content_raises_alarm_state_lost(folder: Path, content: bytes) -> None:
    assert "alarm_state_lost" in restore(folder, content)
