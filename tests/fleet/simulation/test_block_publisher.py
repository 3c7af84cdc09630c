"""Simulated edges with the real server: all blocks reach the stream, and a requested block arrives again."""

import asyncio
import contextlib
from collections import Counter
from pathlib import Path

import nats
import pytest

from bms_estimator.edge.block import decode
from bms_estimator.edge.subjects import RAW_STREAM, BlockRequest, block_request, raw
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.simulation.block_publisher import Report, run_edges
from bms_estimator.fleet.simulation.simulated_edges import RESEND_S, SimulatedEdges
from bms_estimator.fleet.simulation.simulated_fleet import SimulatedFleet
from bms_estimator.settings.connections import MqttSettings
from tests.command_line import run
from tests.fleet.nats_cluster import running
from tests.patience import LONG_S

PACKS, BLOCKS, RESENT_NUMBER = 20, 4, 3
"""Number of packs, number of blocks of each pack, and number of the block that is requested again."""


async def send_blocks(url: str, mqtt: str) -> tuple[Report, Counter[tuple[str, int]], int]:
    """Publish the blocks of all edges, and request block ``RESENT_NUMBER`` of the first edge again.

    Returns:
        The report, the number of arrivals of each block, and the number of requests.
    """
    fleet = SimulatedFleet(PACKS, seed=3, begin_ns=1_700_000_000 * 10**9)
    edges = SimulatedEdges(fleet, start_s=1.7e9, speed=1.0, last=BLOCKS)  # in the past, so that all blocks are due
    received: Counter[tuple[str, int]] = Counter()
    nc = await nats.connect(url)
    await make_streams(nc, partitions=4)
    arrivals = await nc.subscribe(raw("*"))
    await nc.flush()
    stop = asyncio.Event()
    publisher_task = asyncio.create_task(
        run_edges(fleet, edges, MqttSettings(url=mqtt), connections=2, stop=stop, report=str, quiet_s=LONG_S)
    )
    first_pack = fleet.names[0]
    request = (
        BlockRequest(store=int(fleet.store_created_ns[0]), number=RESENT_NUMBER, resend=True).model_dump_json().encode()
    )

    async def receive_one(timeout_s: float) -> None:
        message = await arrivals.next_msg(timeout=timeout_s)
        received[message.subject.split(".")[1], decode(message.data).number] += 1

    while len(received) < PACKS * BLOCKS:
        await receive_one(LONG_S)
    arrivals_before, requests = received[first_pack, RESENT_NUMBER], 0  # above 1 if an acknowledgment was late
    async with asyncio.timeout(LONG_S):
        while received[first_pack, RESENT_NUMBER] == arrivals_before or not edges.repeated:
            await nc.publish(block_request(first_pack), b"no valid request")
            await nc.publish(block_request(first_pack), request)
            requests += 1
            with contextlib.suppress(TimeoutError):  # an edge may miss a request, and ignores repetitions for RESEND_S
                while received[first_pack, RESENT_NUMBER] == arrivals_before or not edges.repeated:
                    await receive_one(RESEND_S)
    stop.set()
    report = await publisher_task
    js = nc.jetstream(timeout=LONG_S)
    async with asyncio.timeout(LONG_S):  # a block is delivered before it is stored
        while (await js.stream_info(RAW_STREAM)).state.messages < PACKS * BLOCKS + 1:  # noqa: ASYNC110 - the server sends no notification
            await asyncio.sleep(0.02)
    await nc.close()
    return report, received, requests


def test_every_block_reaches_the_stream_and_a_requested_block_arrives_again(tmp_path: Path) -> None:
    with running(tmp_path, partitions=4) as cluster:
        report, received, requests = asyncio.run(send_blocks(cluster.url, f"mqtt://127.0.0.1:{cluster.mqtt_port}"))
    assert set(received) == {(f"sim-{i:06d}", n) for i in range(PACKS) for n in range(1, BLOCKS + 1)}
    assert received["sim-000000", RESENT_NUMBER] >= 2
    assert 1 <= report.resends <= requests  # several requests are sent only if a busy machine delays or loses one
    assert report.repeated >= 1


def test_command_writes_table_and_rejects_invalid_options(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    simulate = ("fleet", "simulate", "--packs", 4)
    table = tmp_path / "packs.csv"
    assert run(capsys, *simulate, "--table", table)[0] == 0
    rows = table.read_text().splitlines()
    assert rows[0].startswith("pack,cell,capacity_ah,series,parallel")
    assert rows[1:3] == ["sim-000000,lfp,100.0,16,1,0.01,0.1,1", "sim-000001,nmc,10.0,14,2,0.01,0.05,1"]
    for arguments, message in (
        ((), "--mqtt mqtt://host:port"),
        (("--mqtt", "http://nowhere"), "--mqtt http://nowhere"),
        (("--table", tmp_path / "no" / "packs.csv"), "cannot be written"),
    ):
        code, _, err = run(capsys, *simulate, *arguments)
        assert (code, message in err) == (2, True), err
