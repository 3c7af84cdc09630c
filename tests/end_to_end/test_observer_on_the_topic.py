"""End-to-end test of Algorithm 1 of the thesis, the adaptive observer, from the serial line to the topic.

The test checks delta1 and delta2, the SOCs below which the capacitances of the RC pairs are negative, and N, the observer's
gain. Numbers in parentheses are equations of the thesis.
"""

import asyncio
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bms_estimator.model.cell import load_cell
from tests.end_to_end.test_whole_way import run_program
from tests.mosquitto import Broker, Listener
from tests.serial_line import Line

CELL = load_cell("chen_mora")
STEP_S = 0.1
"""Sample period [s]."""
START_SOC = 0.5
LAMBDA = 50_000.0
"""Parameter lambda of the gain N (3.10). With this large value, N falls within seconds."""
N_ERROR = 0.005
"""Tolerance of N.

The program uses one decay rate of the error e over a sample, so that k, the integral of its square, has an error of 0.5 %.
N falls by 0.5 in this test.
"""
REPEAT_S = 0.05
"""Interval at which the first line is repeated until the program reads the port [s]."""


def make_rows() -> list[tuple[float, float, float]]:
    """Return time [s], current [A] and voltage [V] of each line.

    The initial voltage differs by 0.25 V from that of the observer. A step of the load follows at 2 s.
    """
    return [
        (n * STEP_S, 0.1 if n < 20 else 0.4, round(4.05 - 0.001 * n - (0.02 if n >= 20 else 0.0), 4)) for n in range(40)
    ]


def format_line(row: tuple[float, float, float]) -> bytes:
    """Return a line of the text protocol."""
    return b"time_s=%.1f I=%.1f V=%.4f\r\n" % row


def element_at(a: np.ndarray, first: int, soc: float, sign: float) -> float:
    """Return a resistance (sign 1) or capacitance (sign -1) at an SOC by (2.5) to (2.8), from its three parameters."""
    return float(sign * a[first] * math.exp(-a[first + 1] * soc) + a[first + 2])


def mittag_leffler(k: float) -> float:
    """Return N(k) = E_2.5(-lambda k^2.5) by the series (3.11)."""
    return math.fsum((-LAMBDA * k**2.5) ** j / math.gamma(2.5 * j + 1.0) for j in range(60))


def algorithm_1(samples: list[tuple[float, float, float]]) -> Iterator[tuple[float, float, float]]:
    """Yield delta1, delta2 and N after each sample.

    (3.1) to (3.3), (3.12), (3.13), (3.15), (3.18) and (4.1) are solved in small steps. N and y are constant over a sample, as
    in the program.
    """
    bounds = [CELL.bounds(i) for i in range(1, 13)]  # of a1 to a12; index 0 of the arrays is unused
    limit = np.array([0.0, *(b.limit for b in bounds)])
    rate = np.array([1.0, *(b.rate for b in bounds)])
    a = np.array([0.0, *(b.limit if b.initial is None else b.initial for b in bounds)])
    # x2 and x3 are the voltages of the RC pairs, k is the integral of the squared error
    soc, x2, x3, k, previous_a = START_SOC, 0.0, 0.0, 0.0, samples[0][1]
    a16, a17, a18, a19, a20, a21 = CELL.a[16:22]  # of the OCV (2.10)
    substeps = 4000
    dt_s = STEP_S / substeps
    for n, (_, current_a, voltage_v) in enumerate(samples):
        if n:
            soc -= 0.5 * (previous_a + current_a) * STEP_S / (CELL.cell.capacity_ah * 3600.0)
            e_o = -a16 * math.exp(-a17 * soc) + a18 + a19 * soc - a20 * soc**2 + a21 * soc**3
            tau_ts = element_at(a, 1, soc, 1.0) * element_at(a, 7, soc, -1.0)
            tau_tl = element_at(a, 4, soc, 1.0) * element_at(a, 10, soc, -1.0)
            gain = mittag_leffler(k)
            for _ in range(substeps):
                e = voltage_v - e_o + x2 + x3
                x2 += dt_s * (-x2 / tau_ts - gain * e)
                x3 += dt_s * (-x3 / tau_tl - gain * e)
                k += dt_s * e * e
                a += dt_s * (e * e + rate * (limit - a))
        previous_a = current_a
        yield -math.log(a[9] / a[7]) / a[8], -math.log(a[12] / a[10]) / a[11], mittag_leffler(k)


def pack_file(folder: Path, line: Line, broker: Broker) -> Path:
    pack = folder / "pack.toml"
    pack.write_text(f"""
[pack]
cell = "chen_mora"
initial_soc = {START_SOC}
[sensor]
port = "{line.path}"
protocol = "text"
[observer]
law = "improved"
lambda = {LAMBDA}
dead_zone_v = 0.0
rearm_gain = "never"
lock_error_v = 10.0
[identifier]
enabled = false
[publish]
rate_hz = 10
[mqtt]
url = "{broker.url}"
[state]
folder = "{folder / "state"}"
""")
    return pack


async def state_after(listener: Listener, row: tuple[float, float, float]) -> Any:
    """Return the first published state whose newest sample is this line."""
    return await listener.wait_json("bms/pack/state", lambda s: s["board_time_s"] == pytest.approx(row[0], abs=1e-6))


async def test_published_delta_1_delta_2_and_n_follow_algorithm_1_from_the_received_bytes(
    tmp_path: Path, line: Line, broker: Broker
) -> None:
    samples, expected = make_rows(), list(algorithm_1(make_rows()))
    line.plug()

    async def repeat_first_line() -> None:
        while True:
            line.write(format_line(samples[0]))
            await asyncio.sleep(REPEAT_S)

    async with Listener(broker, "bms/#") as listener, run_program(pack_file(tmp_path, line, broker)):
        repeating = asyncio.create_task(repeat_first_line())
        await state_after(listener, samples[0])
        repeating.cancel()
        published = []
        first = 1
        for last in (1, 2, 12, 39):
            line.write(b"".join(map(format_line, samples[first : last + 1])))
            published.append((last, await state_after(listener, samples[last])))
            first = last + 1
    for last, state in published:
        delta_1, delta_2, gain = expected[last]
        assert state["delta_1"] == pytest.approx(delta_1, rel=2e-3), last
        assert state["delta_2"] == pytest.approx(delta_2, rel=2e-3), last
        assert state["nussbaum_gain"] == pytest.approx(gain, abs=N_ERROR), last
        assert state["stability_margin"] is None, last  # a7..a12 are not valid
        assert state["delta_configured"], last
    gains = [state["nussbaum_gain"] for _, state in published]
    assert gains[0] - gains[-1] > 0.4
    assert published[0][1]["delta_1"] < 0.8 * published[-1][1]["delta_1"]
