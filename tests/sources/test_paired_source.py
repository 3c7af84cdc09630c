"""Battery monitor and BMS of different kinds in one pack: a VE.Direct shunt and a JK-BMS on pseudo-terminals."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack

import pytest

from bms_estimator.settings.pack import Settings
from bms_estimator.simulation.simulated_meter import METERS
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources import factory
from bms_estimator.sources.factory import PairedSource, open_source
from bms_estimator.sources.source import ReceivedSamples
from tests.device_line import running_device
from tests.patience import LONG_S


class Devices:
    """Shunt and BMS of a pack, of which either can be unplugged.

    Attributes:
        source: Source of the pack; not open.
    """

    def __init__(self) -> None:
        self._shunt, self._bms = ExitStack(), ExitStack()
        shunt = METERS["vedirect"](lambda _: Reading(12.5, 52.8), 4.0)
        bms = SimulatedBms("jk", lambda _: Reading(11.0, 52.0, 31.0), cells=16, soc=lambda: 0.62, capacity_ah=280.0)
        ports = self._shunt.enter_context(running_device(shunt)), self._bms.enter_context(running_device(bms))
        sensors = [
            {"port": port, "protocol": protocol} for port, protocol in zip(ports, ("vedirect", "jk"), strict=True)
        ]
        source = open_source(Settings.model_validate({"sensor": sensors[0], "bms": {"sensor": sensors[1]}}))
        assert isinstance(source, PairedSource)
        self.source = source

    async def unplug_shunt(self) -> None:
        await asyncio.to_thread(self._shunt.close)

    async def unplug_bms(self) -> None:
        await asyncio.to_thread(self._bms.close)

    def close(self) -> None:
        self._shunt.close()
        self._bms.close()


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> Iterator[Devices]:
    monkeypatch.setattr(factory, "MAX_AGE_FLOOR_S", 1.0)
    monkeypatch.setattr(factory, "MAX_AGE_PERIODS", 0.5)
    devices = Devices()
    yield devices
    devices.close()


async def find(
    blocks: AsyncIterator[ReceivedSamples], is_found: Callable[[ReceivedSamples], object]
) -> ReceivedSamples:
    async for received in blocks:
        if is_found(received):
            return received
    raise AssertionError("the source has ended")


async def test_current_and_voltage_are_of_the_shunt_and_all_other_values_of_the_bms(devices: Devices) -> None:
    async with asyncio.timeout(LONG_S), devices.source as source:
        received = await find(aiter(source), lambda each: each.cells_v.size)
    last = received.samples[-1]
    assert (last["voltage_v"], last["current_a"]) == pytest.approx((52.8, 12.5))
    assert last["temperature_c"] == pytest.approx(31.0, abs=0.1)
    assert received.cells_v.shape == (received.samples.size, 16)
    assert received.cells_v[-1].sum() == pytest.approx(52.0, abs=0.1)
    assert received.device_soc[-1] == pytest.approx(0.62)
    assert received.device_capacity_ah == pytest.approx(280.0)
    assert source.counters["frames_received_of_bms"] >= 1
    # alarms count ``*_errors`` as lost samples; a JK-BMS counts CRC errors, a VE.Direct device does not
    assert not any(name.endswith("crc_errors") for name in source.counters)


async def test_a_lost_bms_ends_cells_and_temperature_and_a_lost_shunt_ends_the_samples(devices: Devices) -> None:
    async with asyncio.timeout(LONG_S), devices.source as source:
        blocks = aiter(source)
        await find(blocks, lambda each: each.cells_v.size)
        await devices.unplug_bms()
        without_bms = await find(blocks, lambda each: not each.cells_v.size)
        assert without_bms.samples["current_a"] == pytest.approx(12.5)
        assert str(without_bms.samples["temperature_c"][-1]) == "nan"
        assert source.silence_reason is None
        reading = asyncio.ensure_future(anext(blocks))
        await devices.unplug_shunt()
        while source.silence_reason is None:
            await asyncio.wait({reading}, timeout=0.1)
            if reading.done():
                reading = asyncio.ensure_future(anext(blocks))
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
