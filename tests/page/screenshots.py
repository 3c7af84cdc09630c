"""Screenshots of the page for the documentation (``make screenshots``), of an LFP battery of a house with 16 cells.

The battery is simulated faster than real time, with a forecast each hour, and its published snapshots are shown by the page of a
service.
"""

import asyncio
import contextlib
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from playwright.async_api import Browser, expect

from bms_estimator.forecast import forecaster
from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.pack.pack import new_pack
from bms_estimator.page.page_sink import Pages, PageSink
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.connections import PageSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.setup.page.setup_server import SetupServer
from bms_estimator.simulation.simulated_bank import BankCells, SimulatedBank
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from bms_estimator.sources.source import ReceivedSamples
from tests.device_line import running_device
from tests.free_port import free_port
from tests.page.chromium import DESKTOP, PHONE, Tab, chromium, tab
from tests.page.test_setup import answer_questions, compare_voltage, search_and_choose
from tests.patience import LONG_S
from tests.scripted_source import ScriptedSource

DOCS = Path(__file__).parents[2] / "docs" / "images"
CELLS, CAPACITY_AH = 16, 280.0
"""Number of cells, and their capacity [Ah]."""
STEP_S, LIVE_S = 60.0, 600.0
"""Interval of the samples, and duration at the end with a sample each second, which the live curves show [s]."""
Parts = tuple[NDArray[np.void], NDArray[np.float64], NDArray[np.float64]]
"""Samples, cell voltages [V], and SOC of the BMS."""
FULL_V, TAIL_A = 3.41, 14.0
"""Voltage of a cell above which the charger reduces its current [V], and current at which it ends the charge [A]."""
TOP_PX = 500
"""Height of the upper part of the page, with alarms or the note about stale values [px]."""
SETTINGS: dict[str, Any] = {
    "pack": {
        "name": "home",
        "cell": "lfp",
        "capacity_ah": CAPACITY_AH,
        "series": CELLS,
        "device_soc_std": 0.1,
        "full_voltage_v": CELLS * (FULL_V - 0.02),
        "tail_current_a": TAIL_A,
        "max_discharge_a": 200.0,
        "max_charge_a": 140.0,
    },
    "identifier": {"fit_interval_s": 86_400},
    "sensor": {"protocol": "text", "voltage_resolution_v": 0.01, "current_resolution_a": 0.01},
}


class House:
    """Battery of a house, its estimator, and the page that shows it.

    Args:
        days: Duration of the simulation [days].
        soc: SOC at its start.
        hour: Hour of the day at its end.
        settings: Sections that differ from ``SETTINGS``.
    """

    def __init__(self, days: float, soc: float, hour: float, **settings: Any) -> None:
        self.rng = np.random.default_rng(3)
        cells = BankCells.random(self.rng, CELLS, 0.97 * CAPACITY_AH, soc, capacity_std=0.002, soc_std=0.001)
        self.bank = SimulatedBank(load_cell("lfp", CAPACITY_AH), cells)
        self.settings = Settings.model_validate(SETTINGS | settings)
        self.pack = new_pack(self.settings, load_cell("lfp", CAPACITY_AH).pack(CELLS, 1))
        self.days, self.hour, self.time_s, self.charger_a = days, hour, 0.0, 0.0
        self.published_s = 0.0
        self.begin_s = time.time() - 86_400.0 * days

    @contextlib.asynccontextmanager
    async def page(self, folder: Path) -> AsyncIterator[str]:
        """Simulate the battery, and serve its page. Yield the URL."""
        page = PageSettings(listen=f"127.0.0.1:{free_port()}")
        async with PageSink(Pages(), page, "home", folder / "none") as sink:
            clock = Clock(wall=lambda: self.begin_s + self.published_s, monotonic=lambda: self.published_s)
            publisher = Publisher(self.settings, self.pack, source=ScriptedSource(), sinks=[sink], clock=clock)
            while (rest_s := 86_400.0 * self.days - LIVE_S - self.time_s) > 0.0:
                with patch.multiple(forecaster, RETRY_S=3600.0, MIN_INTERVAL_S=3600.0, MAX_INTERVAL_S=3600.0):
                    self.publish(publisher, [self.run(STEP_S) for _ in range(60 if rest_s > 86_400.0 else 5)])
            while self.time_s < 86_400.0 * self.days:
                minute = self.run(1.0)
                for parts in zip(*(np.split(part, 60) for part in minute), strict=True):
                    self.publish(publisher, [parts])
            publisher.publish_last()
            yield f"http://{page.listen}/"

    def run(self, step_s: float) -> Parts:
        """Simulate a minute. Return its samples, its cell voltages [V], and the SOC of the BMS."""
        count = round(60.0 / step_s)
        history = self.bank.run(self.current_a() + 0.3 * self.rng.standard_normal(count), step_s)
        self.charger_a *= 0.7 if history.cell_v.max() > FULL_V else 1.0
        samples, soc = history.samples(self.rng, 2e-3, 0.01), float(self.bank.soc.mean())
        cells_v = np.round(history.cell_v + 5e-4 * self.rng.standard_normal(history.cell_v.shape), 3)
        self.time_s = float(samples["time_s"][-1]) + step_s
        return samples, cells_v, np.full(count, round(min(soc + 0.04, 1.0), 2))

    def publish(self, publisher: Publisher, parts: Sequence[Parts]) -> None:
        """Publish once after consecutive parts."""
        samples, cells_v, device_soc = (np.concatenate(part) for part in zip(*parts, strict=True))
        self.published_s = float(samples["time_s"][-1])
        received = ReceivedSamples(samples, cells_v, device_soc=device_soc)
        publisher.add(received, self.pack.run(samples, cells_v, device_soc))

    def current_a(self) -> float:
        """Return the current of the house [A]: the sun charges it from 8 to 16 h until it is full."""
        hour = (self.hour + (self.time_s - 86_400.0 * self.days) / 3600.0) % 24.0
        if not 8.0 <= hour < 16.0:
            self.charger_a = 70.0
            return 12.0 + 4.0 * float(np.sin(self.time_s / 3000.0))
        return -self.charger_a if self.charger_a > 0.7 * TAIL_A else 0.0


async def shoot(page_tab: Tab, name: str, *, top: bool = False) -> None:
    """Write a screenshot of the page, or of its upper part (``top``)."""
    path, clip = DOCS / f"page-{name}.png", {"x": 0, "y": 0, "width": DESKTOP["width"], "height": TOP_PX}
    await page_tab.page.screenshot(path=path, **({"clip": clip} if top else {"full_page": True}))
    sys.stdout.write(f"{path.relative_to(DOCS.parents[1])}: {path.stat().st_size / 1e3:.0f} kB\n")


@contextlib.asynccontextmanager
async def open_page(browser: Browser, url: str, **options: Any) -> AsyncIterator[Tab]:
    """Open the page and wait until its curves are drawn."""
    async with tab(browser, url, **options) as page_tab:
        await page_tab.until_status("live")
        await page_tab.until("() => document.querySelectorAll('.curve [aria-label]').length >= 4")
        yield page_tab


async def shoot_week(folder: Path, browser: Browser) -> None:
    """Write screenshots of a pack after a week, discharging."""
    async with House(7.0, 0.6, 20.0).page(folder) as url:
        async with open_page(browser, url) as page_tab:
            await shoot(page_tab, "desktop")
        async with open_page(browser, url, size=PHONE, device_scale_factor=1.5) as page_tab:
            await shoot(page_tab, "phone")


async def shoot_stale(folder: Path, browser: Browser) -> None:
    """Write a screenshot of a page that is open while its service ends."""
    async with contextlib.AsyncExitStack() as stack:
        service = contextlib.AsyncExitStack()
        url = await service.enter_async_context(House(0.1, 0.6, 20.0).page(folder))
        page_tab = await stack.enter_async_context(open_page(browser, url))
        await service.aclose()
        await page_tab.until_status("stale since")
        await shoot(page_tab, "stale", top=True)


async def shoot_states(folder: Path, browser: Browser) -> None:
    """Write screenshots of the first minutes without the SOC of the BMS, and of a pack with alarms."""
    alarms = {"soc_low": {"limit": 0.6, "delay_s": 1}, "cell_imbalance": {"limit_v": 0.002, "delay_s": 1}}
    pack = {key: value for key, value in SETTINGS["pack"].items() if key != "device_soc_std"}
    for name, house in (
        ("unknown", House(0.02, 0.55, 20.0, pack=pack)),
        ("alarm", House(1.0, 0.5, 6.0, alarms=alarms)),
    ):
        async with house.page(folder) as url, open_page(browser, url) as page_tab:
            await page_tab.page.locator(".alarm" if name == "alarm" else "#unknownsoc").first.wait_for()
            await shoot(page_tab, name, top=True)


async def shoot_setup(folder: Path, browser: Browser) -> None:
    """Write screenshots of two steps of the setup page."""
    bms = SimulatedBms("jk", lambda _: Reading(35.0, 52.8, 21.0), cells=16, soc=lambda: 0.62, capacity_ah=CAPACITY_AH)
    page = PageSettings(listen="127.0.0.1:0")
    installed = patch("sys.executable", "/opt/bms-estimator/bin/python3")  # the page names the program beside it
    with running_device(bms) as path, contextlib.chdir(folder), installed:
        async with (
            SetupServer(page, Path("pack.toml")) as server,
            tab(browser, server.url, size=PHONE, device_scale_factor=1.5) as page_tab,
        ):
            await search_and_choose(page_tab.page, path)
            await compare_voltage(page_tab.page)
            await page_tab.page.screenshot(path=DOCS / "setup-multimeter.png")
            await answer_questions(page_tab.page)
            await page_tab.until("() => document.getElementById('wait').hidden")
            await page_tab.page.screenshot(path=DOCS / "setup-estimate.png")


async def main() -> None:
    expect.set_options(timeout=1e3 * LONG_S)  # for a busy machine
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        async with chromium() as browser:
            for shots in (shoot_states, shoot_week, shoot_stale, shoot_setup):
                await shots(folder, browser)


if __name__ == "__main__":
    asyncio.run(main())
