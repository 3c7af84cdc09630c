"""JBD BMS over Bluetooth with aiobmsble and bleak, and with a simulated BlueZ on a private D-Bus."""

import asyncio
import json
import shutil
from collections.abc import AsyncGenerator
from contextlib import aclosing
from pathlib import Path

import pytest

from bms_estimator.model.errors import UserError
from bms_estimator.protocols.base.reading import CONNECTED
from bms_estimator.settings.sources.source import BleSource
from bms_estimator.sources.source import LineProducer, SourceUnavailableError
from tests.patience import LONG_S

SKIP_REASON = "aiobmsble is not installed: it needs Python 3.12 and the extra ble"
ble_bms = pytest.importorskip("bms_estimator.sources.bluetooth.client", reason=SKIP_REASON)
bluez = pytest.importorskip("tests.sources.bluetooth.bluez", reason=SKIP_REASON)
if shutil.which("dbus-daemon") is None:
    pytest.skip("dbus-daemon is not installed", allow_module_level=True)

JBD_SAMPLE = {"voltage_v": 15.6, "current_a": -2.87, "temperature_c": 22.133, "cells_v": [3.43, 3.425, 3.432, 3.417]}
"""Values of the simulated BMS. aiobmsble's current is positive on charge."""


def make_producer(**options: object) -> LineProducer:
    producer: LineProducer = ble_bms.BleProducer(BleSource.model_validate({"kind": "ble", "poll_s": 0.5} | options))
    return producer


async def read_to_end(lines: AsyncGenerator[bytes, None]) -> None:
    async for _ in lines:
        pass


async def test_bms_is_polled_and_can_be_reconnected_after_it_was_out_of_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with asyncio.timeout(LONG_S), bluez.system_bus(tmp_path) as bus:
        simulated = bluez.BlueZ(bus)
        await bus.request_name("org.bluez")
        producer = make_producer(address=bluez.ADDRESS.lower())
        async with aclosing(producer.iter_lines()) as lines:
            assert await anext(lines) == CONNECTED
            assert [json.loads(await anext(lines)) for _ in range(2)] == 2 * [JBD_SAMPLE]
            simulated.leave()
            with pytest.raises(SourceUnavailableError):
                await read_to_end(lines)
        monkeypatch.setattr(ble_bms, "SCAN_S", 0.2)  # the scan finds no BMS
        with pytest.raises(SourceUnavailableError, match="does not advertise"):
            await read_to_end(producer.iter_lines())
        monkeypatch.undo()
        simulated.in_range = True
        async with aclosing(make_producer(name=bluez.NAME, bms="jbd").iter_lines()) as lines:
            assert await anext(lines) == CONNECTED
            assert json.loads(await anext(lines)) == JBD_SAMPLE


def test_bms_type_that_aiobmsble_does_not_support_is_rejected() -> None:
    with pytest.raises(UserError, match=r"source\.bms = 'jbdd': aiobmsble supports abc, .*jbd"):
        make_producer(address=bluez.ADDRESS, bms="jbdd")
