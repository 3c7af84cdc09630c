"""Screenshots of the page for the documentation (``make screenshots``).

The page is that of a service of a simulated pack. Its history of the day before is simulated, too.
"""

import asyncio
import contextlib
import itertools
import math
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from playwright.async_api import Browser

from bms_estimator.model.clock import iso_utc
from bms_estimator.model.payloads.snapshot import Snapshot
from bms_estimator.settings.page import PageSettings
from bms_estimator.setup.page.setup_server import SetupServer
from bms_estimator.simulation.simulated_bms import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from tests.device_line import running_device
from tests.free_port import free_port
from tests.mosquitto import Broker
from tests.page.chromium import PHONE, Tab, chromium, tab
from tests.page.house import SERIES, Service, simulated
from tests.page.test_setup import answer_questions, compare_voltage, search_and_choose
from tests.sinks.snapshots import CELL_SNAPSHOT
from tests.store.test_history import record_history

DOCS = Path(__file__).parents[2] / "docs" / "images"
LEARN_S = 30.0
"""Time before the screenshot with alarms in which the estimator identifies the pack [s]."""
FORECAST_TIMEOUT_S = 600.0
"""Timeout of the first curves of a forecast, which need 300 s of load [s]."""
TOP_PX = 500
"""Height of the upper part of the page, with alarms or the note about stale values [px]."""
END_SOC = 0.66
"""Approximate SOC at the end of the simulated day."""
CAPACITY_AH = 30.0
"""Capacity of the pack in ``tests.page.house``."""
# limits at which the simulated pack raises both alarms
ALARMS = """
[alarms]
cell_imbalance = {limit_v = 0.02, delay_s = 1, severity = "critical"}
soc_low = {limit = 0.9, delay_s = 1}
"""


def make_day_before() -> list[Snapshot]:
    """Return the snapshots of the last 24 hours, one per minute. The pack is charged by day and discharged at night."""
    assert CELL_SNAPSHOT.estimate
    times = [time.time() - 60.0 * minute for minute in range(24 * 60, 0, -1)]
    currents = [_current_a(time_s) for time_s in times]
    soc_changes = [-charge_a_min / 60.0 / CAPACITY_AH for charge_a_min in itertools.accumulate(currents)]
    snapshots = []
    for time_s, current_a, soc_change in zip(times, currents, soc_changes, strict=True):
        soc = END_SOC + soc_change - soc_changes[-1]
        voltage_v = SERIES * (3.35 + 0.75 * soc - 5e-3 * current_a)  # roughly an NMC cell
        values = {
            "time": iso_utc(time_s),
            "board_time_s": time_s,
            "voltage_v": voltage_v,
            "current_a": current_a,
            "power_w": voltage_v * current_a,
            "soc": soc,
            "soc_std": 0.012,
            "temperature_c": 24.0 - 0.5 * current_a,
        }
        snapshots.append(CELL_SNAPSHOT._replace(estimate=CELL_SNAPSHOT.estimate.model_copy(update=values)))
    return snapshots


def _current_a(time_s: float) -> float:
    """Return the current of a house with a solar generator, which charges for 8 h a day."""
    hour = time_s % 86_400 / 3600.0
    return 0.9 + 0.3 * math.sin(time_s / 700.0) - 4.0 * max(0.0, 1.0 - ((hour - 12.5) / 4.0) ** 2)


async def shoot(page_tab: Tab, name: str, part: str = "", *, top: bool = False) -> None:
    """Write a screenshot of the page, of its upper part (``top``), or of one element (``part``, a CSS selector)."""
    path = DOCS / f"page-{name}.png"
    if part:
        await page_tab.page.locator(part).screenshot(path=path)
    else:
        await page_tab.page.screenshot(
            path=path, clip={"x": 0, "y": 0, "width": 1280, "height": TOP_PX} if top else None
        )
    sys.stdout.write(f"{path.relative_to(DOCS.parents[1])}: {path.stat().st_size / 1e3:.0f} kB\n")


@contextlib.asynccontextmanager
async def open_page(browser: Browser, service: Service, **options: Any) -> AsyncIterator[Tab]:
    """Open the page and wait until its curves are drawn."""
    async with tab(browser, service.url, **options) as page_tab:
        await page_tab.until_status("live")
        await page_tab.until("() => document.querySelectorAll('.curve [aria-label]').length >= 4")
        yield page_tab


async def shoot_all(service: Service, browser: Browser) -> None:
    """Write all screenshots. The service is killed for one of them, and restarted with alarms."""
    async with open_page(browser, service) as page_tab:
        await page_tab.page.locator("#forecast .curve").last.wait_for(timeout=1e3 * FORECAST_TIMEOUT_S)
        await shoot(page_tab, "desktop")
        await shoot(page_tab, "cells", ".cells")
        await page_tab.page.get_by_text("Day", exact=True).click()
        await page_tab.page.get_by_role("img", name="Voltage, last day: from").wait_for()
        await shoot(page_tab, "day", ".curves")
    async with open_page(browser, service, size=PHONE, device_scale_factor=1.5) as page_tab:
        await shoot(page_tab, "phone")
    async with open_page(browser, service, color_scheme="dark") as page_tab:
        await shoot(page_tab, "dark")
        await service.kill()
        await page_tab.until_status("stale since")
        await shoot(page_tab, "stale", top=True)
    await service.start(ALARMS)
    async with open_page(browser, service) as page_tab:
        await page_tab.page.locator(".alarm").nth(1).wait_for()
        await asyncio.sleep(LEARN_S)
        await shoot(page_tab, "alarm", top=True)


async def shoot_setup(folder: Path, browser: Browser) -> None:
    """Write screenshots of two steps of the setup page."""
    bms = SimulatedBms("jk", lambda _: Reading(5.0, 26.4, 21.0), cells=8)
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
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        async with chromium() as browser:
            await shoot_setup(folder, browser)
        broker = Broker(folder).start()
        try:
            async with Service(folder, broker, free_port(), simulated(soc=END_SOC)) as service, chromium() as browser:
                # after the first start, because a history without saved alarms would raise alarm_state_lost
                await service.kill()
                await record_history(folder / "attic.sqlite", make_day_before())
                await service.start()
                await shoot_all(service, browser)
        finally:
            broker.stop()


if __name__ == "__main__":
    asyncio.run(main())
