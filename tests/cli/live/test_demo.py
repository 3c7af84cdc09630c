"""Process of command ``demo``: messages to a client of its broker, from the first state to offline."""

import asyncio
import contextlib
import json
import re
import socket
from datetime import datetime
from types import SimpleNamespace

import aiohttp
import aiomqtt
import pytest

from tests.command_line import PROGRAM, run, running_program
from tests.free_port import free_port
from tests.mosquitto import Listener
from tests.patience import LONG_S


def demo(*arguments):
    """Run ``demo`` as a process, which is killed at the end."""
    return running_program(PROGRAM, "demo", *arguments)


async def connect_listener(port):
    """Connect to the broker of a demo as soon as it listens. Return the listener, which the test must close."""
    async with asyncio.timeout(LONG_S):
        while True:
            listener = Listener(SimpleNamespace(port=port))
            with contextlib.suppress(aiomqtt.MqttError):
                return await listener.__aenter__()
            await asyncio.sleep(0.1)


async def test_client_receives_states_from_start_to_offline():
    port, page = free_port(), free_port()
    ports = ("--port", port, "--page-port", page)
    async with demo("--seconds", 4, *ports) as process:
        listener = await connect_listener(port)
        try:
            assert await listener.wait("bms/demo/availability") == b"online"
            state = await listener.wait_json("bms/demo/state", lambda s: s["frames_received"] > 100)
            async with aiohttp.ClientSession(f"http://127.0.0.1:{page}") as browser, browser.get("/events") as events:
                first_lines = [await events.content.readline() for _ in range(3)]
            parameters = await listener.wait_json("bms/demo/parameters")
            info = await listener.wait_json("bms/demo/info", lambda i: i.get("board"))
            assert await listener.wait("bms/demo/sensor/availability", lambda p: p == b"online")
            health = await listener.wait_json("bms/demo/health")
            assert await listener.wait("bms/demo/availability", lambda p: p == b"offline")
        finally:
            await listener.__aexit__(None, None, None)
        async with asyncio.timeout(LONG_S):
            out, err = (text.decode() for text in await process.communicate())
    assert process.returncode == 0
    assert 0.8 < state["soc"] < 0.95
    assert state["voltage_v"] == pytest.approx(3.9, abs=0.2)
    assert state["lock"] is True
    assert state["frames_lost"] == state["crc_errors"] == 0
    assert set(parameters["a"]) == {f"a{i}" for i in range(1, 22)}
    assert (info["device"], info["cell"], info["board"]["sample_rate_hz"]) == ("demo", "chen_mora", "100")
    assert health["line"]
    assert {"demo/state", "demo/health", "demo/info"} <= json.loads(first_lines[-1].removeprefix(b"data: ")).keys()
    assert f"live page: http://127.0.0.1:{page}/" in out
    assert f"mosquitto_sub -p {port} -t 'bms/#' -v" in out
    assert re.search(r" soc \d+\.\d\d ± \d+\.\d\d %  true \d+\.\d\d %  ", out)
    assert re.search(
        r"\d+\.\d s: \d+ frames, 0 lost, 0 CRC errors; SOC error -20\.00% at the start, [+-]\d\.\d\d% at the end: "
        r"true SOC \d+\.\d\d% inside the estimate \d+\.\d\d% ± \d+\.\d\d% \(2 std\); observer in lock\n$",
        out,
    )
    assert "Traceback" not in err


@pytest.mark.thorough
async def test_the_method_of_the_thesis_runs_alone_and_moves_its_parameters_to_the_middle_of_their_bounds():
    port = free_port()
    async with demo("--thesis", "--speed", 5, "--rate-hz", 20, "--port", port) as process:
        listener = await connect_listener(port)
        try:
            # the SOC begins to fall from 0.9 after a rest, during which the parameters converge
            first = await listener.wait_json("bms/demo/parameters", lambda p: p["a"] and p["a"]["a1"]["value"] > 1.0)
            # a10, with the smallest weights, has a time constant of 25 s
            state = await listener.wait_json("bms/demo/state", lambda s: s["board_time_s"] > 125.0)
            last = await listener.wait_json("bms/demo/parameters", lambda p: p["soc"] and p["soc"] < 0.897)
        finally:
            await listener.__aexit__(None, None, None)
        process.terminate()
        async with asyncio.timeout(LONG_S):
            out, _ = await process.communicate()
    assert first["a"]["a4"]["value"] > 1.5 * last["a"]["a4"]["value"]
    limits = {"a1": 0.55, "a2": 30.0, "a4": 5.5, "a6": 0.055}  # both bounds have equal weights, therefore their mean
    assert {name: last["a"][name]["value"] for name in limits} == pytest.approx(limits, rel=0.02)
    assert last["elements"]["r_s_ohm"]["value"] == pytest.approx(0.0745, rel=0.1)  # the true R_s; (4.2) of the thesis
    assert (state["soc_std"], state["time_to_cutoff_s"]) == (None, None)
    assert state["delta_2"] == pytest.approx(0.0179, rel=0.02)  # ln(a10 / a12) / a11 with a10..a12 at their limits
    assert state["nussbaum_gain"] == pytest.approx(1.0, abs=0.01)  # N(0) is 1, and k has hardly grown
    assert re.search(rb"true SOC \d+\.\d\d%, by coulomb counting \d+\.\d\d%; observer", out)


@pytest.mark.thorough
async def test_estimate_follows_a_demo_that_runs_faster_than_the_wall_clock():
    port = free_port()
    async with demo("--speed", 5, "--port", port):
        listener = await connect_listener(port)
        try:
            info = await listener.wait_json("bms/demo/info")
            started = datetime.fromisoformat(info["started"])

            def is_ahead_of_wall_clock(state):
                since_s = (datetime.fromisoformat(state["publish_time"]) - started).total_seconds()
                return state["board_time_s"] > 2.0 * since_s

            state = await listener.wait_json("bms/demo/state", is_ahead_of_wall_clock)
        finally:
            await listener.__aexit__(None, None, None)
    assert state["sample_rate_hz"] == pytest.approx(100.0, rel=0.01)
    assert state["lock"] is True


@pytest.mark.parametrize("option", ["--port", "--page-port"])
def test_occupied_port_is_reported_with_its_option(capsys, option):
    with socket.create_server(("127.0.0.1", 0)) as occupant:
        port = occupant.getsockname()[1]
        code, _, err = run(capsys, "demo", "--seconds", 1, option, port)
    assert code == 2
    assert err.endswith(f"error: port {port}: in use or not permitted; without {option} a free port is chosen\n")
