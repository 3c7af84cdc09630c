"""Whatever the size, no line is too long, and what matters is whole."""

import io

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.estimate import Snapshot
from bms_estimator.model.sample import SAMPLE
from bms_estimator.model.settings import Settings
from bms_estimator.model.suspect import Suspect
from bms_estimator.service.live import new_estimator
from bms_estimator.sinks.console_view import Scene, View
from bms_estimator.snapshot.publisher import Publisher
from tests.collector import Collector
from tests.scripted_source import ScriptedSource
from tests.sinks.snapshots import STACK

SILENT = (
    "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0 at 500000 baud: bytes come, but no valid frame among them"
)
SUSPECTS = [suspect.text for suspect in Suspect][:1]
LOG = [f"12:00:0{n}Z [warning] faults on the line frames_lost={n} crc_errors={n} overruns={n}" for n in range(5)]
HINT = "firmware in simavr; in a second terminal: mosquitto_sub -p 18833 -t 'bms/#' -v"


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    """Of 24 V and 12.5 A, after a second."""
    cell = load_cell("thunder_power_6s")
    estimator, sink = new_estimator(Settings(), cell), Collector()
    publisher = Publisher(Settings(), cell, estimator, source=ScriptedSource(), sinks=[sink], clock=Clock())
    block = np.zeros(100, dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["current_a"] = np.arange(100) / 100.0, 24.123, 12.5
    block["temperature_c"] = np.nan
    publisher.add(block, estimator.run(block))
    publisher.publish()
    return next(each for each in sink.snapshots if each.estimate)


def drawn(scene: Scene, columns: int, rows: int) -> list[str]:
    console = Console(file=io.StringIO(), width=columns, height=rows, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(View(scene))
    return capture.get().splitlines()


@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(32, 8), (40, 15), (60, 20), (80, 12), (80, 24), (120, 40), (200, 60)])
def test_no_line_is_longer_than_the_screen_and_what_matters_is_whole(
    snapshot: Snapshot, columns: int, rows: int, *, wrong: bool
) -> None:
    if wrong:
        rows = max(rows, 15)
        told = {"sensor_online": False, "sensor_message": SILENT, "suspects": SUSPECTS}
        snapshot = snapshot._replace(health=snapshot.health.model_copy(update=told))
    history = tuple(np.linspace(20.0, 25.0, 300))
    scene = Scene(snapshot, snapshot.estimate, history, history, LOG, HINT, true_soc=0.5)
    lines = drawn(scene, columns, rows)
    assert len(lines) <= rows
    assert max(map(cell_len, lines)) <= columns
    text = " ".join(" ".join(lines).split())
    e = snapshot.estimate
    assert e is not None
    assert e.soc is not None
    assert e.soc_std is not None
    assert f"SOC {e.soc:.2%} ± {2.0 * e.soc_std:.2%}" in text
    assert "24.123 V" in text
    assert "+12.500 A" in text
    for message in [SILENT, *SUSPECTS] if wrong else ["health good"]:
        assert "".join(message.split()) in "".join(lines).replace(" ", "")  # a path may be longer than a line


@pytest.mark.parametrize(("columns", "rows"), [(60, 30), (80, 24), (120, 40)])
def test_of_a_fuel_cell_what_is_learned_is_shown_and_no_charge(columns: int, rows: int) -> None:
    text = " ".join(" ".join(drawn(Scene(STACK, STACK.estimate), columns, rows)).split())
    for shown in ("r 167.7 ±", "i_0 0.92", "i_n 6", "C 0.067 ±", "13.000 V"):
        assert shown in text, text
    for absent in ("SOC", "State of charge", "░", "empty in", "R_ts"):
        assert absent not in text


def test_before_the_first_sample_there_is_a_screen_too(snapshot: Snapshot) -> None:
    lines = drawn(Scene(snapshot, None), 80, 24)
    assert max(map(cell_len, lines)) <= 80
    assert "SOC -" in " ".join(lines)


@pytest.mark.parametrize(("rows", "observer", "log"), [(40, True, True), (12, True, False), (7, False, False)])
def test_a_low_screen_drops_the_log_first_and_the_observer_later(
    snapshot: Snapshot, rows: int, *, observer: bool, log: bool
) -> None:
    text = "\n".join(drawn(Scene(snapshot, snapshot.estimate, log=LOG), 60, rows))
    assert ("observer" in text, LOG[-1][:30] in text) == (observer, log)
