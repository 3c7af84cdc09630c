"""Flow in a real Node-RED with a real broker (``make integrations`` installs Node-RED)."""

import asyncio
import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import pytest

from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.sinks.mqtt.messages import MessageBuilder
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.patience import LONG_S
from tests.sinks.snapshots import CELL_SNAPSHOT, SOC_LOW_ALARM

ROOT = Path(__file__).parents[2]
NODE_RED = ROOT / ".node/node_modules/.bin/node-red"
FLOW: list[dict[str, Any]] = json.loads((ROOT / "deploy/node-red/bms.json").read_text(encoding="utf-8"))
NODES_BY_ID = {node["id"]: node for node in FLOW}


def test_all_wires_lead_to_nodes_and_all_fields_are_published() -> None:
    assert len(NODES_BY_ID) == len(FLOW)
    wired = {target for node in FLOW for wires in node.get("wires", []) for target in wires}
    assert wired <= set(NODES_BY_ID)
    assert {node["broker"] for node in FLOW if node["type"] == "mqtt in"} == {"bms-broker"}
    assert set(re.findall(r"\bs\.(\w+)", NODES_BY_ID["bms-left"]["func"])) <= set(Estimate.model_fields)
    assert set(re.findall(r"\balarm\.(\w+)", NODES_BY_ID["bms-each"]["func"])) <= set(Alarm.model_fields)


class NodeRed:
    """Running Node-RED with the flow, changed so that its debug nodes write to standard output.

    Attributes:
        output: Output that ``until`` has read.
    """

    def __init__(self, folder: Path, broker: Broker) -> None:
        self._folder, self.output = folder, ""
        flow = copy.deepcopy(FLOW)
        for node in flow:
            if node["type"] == "mqtt-broker":
                node |= {"broker": "127.0.0.1", "port": str(broker.port)}
            elif node["type"] == "debug":
                node["console"] = True
            elif node["type"] == "delay":
                node["rateUnits"] = "second"  # in place of a minute, for which the test would wait
        (folder / "flows.json").write_text(json.dumps(flow))

    async def __aenter__(self) -> Self:
        port = free_port()
        self._process = await asyncio.create_subprocess_exec(
            *(NODE_RED, "--userDir", self._folder, "-D", "uiHost=127.0.0.1", "-D", f"uiPort={port}", "flows.json"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            cwd=self._folder,
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        self._process.terminate()
        await self._process.communicate()

    async def until(self, condition: Callable[[str], bool]) -> None:
        """Read output until the condition is true for all of it."""
        assert self._process.stdout
        try:
            async with asyncio.timeout(LONG_S):
                while not condition(self.output):
                    data = await self._process.stdout.read(1 << 16)
                    assert data, self.output
                    self.output += data.decode()
        except TimeoutError:
            raise AssertionError(self.output) from None


async def test_remaining_charge_and_alarms_are_reported(broker: Broker, tmp_path: Path) -> None:
    if not NODE_RED.exists():
        pytest.skip("node-red is not installed (make integrations)")

    async def publish_alarm(client: Listener, *, active: bool) -> None:
        payload = SOC_LOW_ALARM.model_copy(update={"active": active, "text": "charge it soon" if active else ""})
        await client.publish("bms/attic/alarm/soc_low", payload.model_dump_json(), qos=1, retain=True)

    async with Listener(broker) as client:
        await client.publish("bms/attic/alarm/over_temperature", '{"active": false}', qos=1, retain=True)
        await publish_alarm(client, active=True)
        async with NodeRed(tmp_path, broker) as program:
            await program.until(lambda output: "attic: warning: charge it soon" in output)
            await publish_alarm(client, active=True)  # a repetition, which the flow must not report
            await publish_alarm(client, active=False)
            await program.until(lambda output: "attic: soc_low is over" in output)
            [state] = [
                m
                for m in MessageBuilder("bms", "attic").guaranteed_messages(CELL_SNAPSHOT, CELL_SNAPSHOT)
                if m.topic == "bms/attic/state"
            ]
            await client.publish(state.topic, state.payload, qos=1)
            await program.until(lambda output: re.search(r"soc_percent: (49\.9|50)", output) is not None)
    assert program.output.count("charge it soon") == 1
    assert "over_temperature" not in program.output
    assert not re.search(r"\[error\]|TypeError", program.output), program.output
