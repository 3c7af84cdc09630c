"""Screenshots of docs/fleet/questions.md in a real Chromium (``make screenshots``), of a simulated fleet on the real server."""

import asyncio
import json
import sys
import tempfile
from pathlib import Path

import nats
import numpy as np
from nats.aio.client import Client

from bms_estimator.edge import subjects
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.page.fleet_page import fleet_page
from bms_estimator.fleet.page.nats_feed import Server
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.connections import PageSettings
from tests.fleet.hour_rows import BEGIN, FIRST_STD, estimate_capacities, write_fleet
from tests.fleet.nats_cluster import running
from tests.fleet.published_states import Pack, load, make_packs, publish, publish_heartbeat
from tests.page.chromium import PHONE, Tab, chromium, tab
from tests.sinks.snapshots import CELL_SNAPSHOT

DOCS = Path(__file__).parents[2] / "docs" / "images"
PACKS, SILENT, DAYS = 5000, 12, 90
"""Number of packs, number of silent packs, and number of days of hour rows."""
SUSPECTED = {
    7: InputFault.CAPACITY,
    40: InputFault.OFFSET,
    93: InputFault.SIGN_OF_CURRENT,
    161: InputFault.OUTLIERS | InputFault.OCV,
}
"""Suspected input faults by index of the pack."""
OVERVIEW_S = 0.2
"""Update interval of the page [s]."""
TOP_PX = 420
"""Height of the screenshots of the page in dark mode and of the stale page [px]."""


def write_hours(folder: Path, names: list[str]) -> None:
    """Write hour rows of packs that lose 3 % of their capacity in a year. Two packs have lost much before."""
    rng = np.random.default_rng(3)
    first_day = rng.normal(-0.03, 0.015, (len(names), 1))  # ln(capacity)
    first_day[:2] -= 0.4
    truth = first_day - rng.normal(0.03, 0.01, (len(names), 1)) * np.arange(DAYS) / 365.25
    logs, variance = estimate_capacities(rng, truth, std=0.01, daily_throughput=1.0)
    ratio = np.exp(logs)
    write_fleet(
        folder, BEGIN + 24 * np.arange(DAYS) + 23, names, cell="lfp", series=16, capacity_ah=280.0,
        capacity_ratio=ratio, capacity_ratio_std=ratio * np.sqrt(variance), capacity_first_std=FIRST_STD, charge_out_ah=280.0,
    )  # fmt: skip


async def work(nc: Client, packs: list[Pack]) -> None:
    """Publish what two workers would, until cancelled. Some packs are silent, one is unknown."""
    rounds = 0
    while True:
        rounds += 1
        # each worker has half of the packs, with a sample a second and a block a minute; a round takes a second
        counts = {"packs": PACKS // 2, "blocks": rounds * PACKS // 120, "samples": rounds * PACKS // 2}
        await publish_heartbeat(nc, "cellar", range(32), lag_s=0.6, unknown_count=1, **counts)
        await publish_heartbeat(nc, "loft", range(32, 64), lag_s=0.9, **counts)
        for pack in packs[:-SILENT] if rounds % 5 == 1 else ():
            await publish(nc, pack.name, pack.state)
        for index, suspects in SUSPECTED.items():
            await nc.publish(subjects.hours(packs[index].name), json.dumps({"suspects": int(suspects)}).encode())
        await nc.publish(subjects.unknown("home-900001"), b"not in the table of packs")
        for pack in packs[:100] if rounds % 5 == 1 else ():
            await nc.publish(f"bms.{pack.name}.parameters", CELL_SNAPSHOT.parameters.model_dump_json().encode())
        await asyncio.sleep(1.0)


async def shoot(browser_tab: Tab, name: str, selector: str = "", height: int = 0) -> None:
    """Save a screenshot of the element of a selector, or else of the top of the page with a height [px]."""
    path, page = DOCS / f"fleet-page-{name}.png", browser_tab.page
    if selector:
        await page.locator(selector).screenshot(path=path)
    else:
        size = page.viewport_size
        assert size
        await page.screenshot(path=path, clip={"x": 0, "y": 0, "width": size["width"], "height": height})
    sys.stdout.write(f"{path.relative_to(DOCS.parents[1])}: {path.stat().st_size / 1e3:.0f} kB\n")


async def shoot_all(url: str, kill: asyncio.Event) -> None:
    """Save all screenshots. ``kill`` is set before the last one, which needs a server that was killed."""
    async with chromium() as browser:
        async with tab(browser, url, size={"width": 1280, "height": 990}) as browser_tab:
            await wait_until_complete(browser_tab)
            await shoot(browser_tab, "desktop", height=990)
            await shoot(browser_tab, "time", ".time")
            await browser_tab.page.locator("#concerns button", has_text="home-000007").click()
            await browser_tab.page.locator("#parameters tr").nth(5).wait_for()
            await shoot(browser_tab, "pack", "dialog")
        async with tab(browser, url, size={**PHONE, "height": 1220}) as browser_tab:
            await wait_until_complete(browser_tab)
            await shoot(browser_tab, "phone", height=1220)
        async with tab(browser, url, color_scheme="dark") as browser_tab:
            await wait_until_complete(browser_tab)
            await shoot(browser_tab, "dark", height=TOP_PX)
            kill.set()
            await browser_tab.until_status("stale since")
            await shoot(browser_tab, "stale", height=TOP_PX)


async def wait_until_complete(browser_tab: Tab) -> None:
    """Wait until the page shows all packs and the results of the queries."""
    await browser_tab.until_text("known", f"of {PACKS:,}")
    await browser_tab.until_text("alive", f"{PACKS - SILENT:,}")
    await browser_tab.until("() => document.querySelectorAll('#answers tbody tr').length > 2")


async def main() -> None:
    with tempfile.TemporaryDirectory() as temporary, running(Path(temporary)) as cluster:
        nc, kill, packs = await nats.connect(cluster.url), asyncio.Event(), make_packs(PACKS)
        await make_streams(nc)
        await load(nc, packs)
        hours = Path(temporary) / "hours"
        write_hours(hours, [pack.name for pack in packs if pack.name.startswith("home")][:300])
        async with fleet_page(
            Server(cluster.url), PageSettings(listen="127.0.0.1:0"), hours, overview_s=OVERVIEW_S
        ) as url:
            working = asyncio.create_task(work(nc, packs))
            shooting = asyncio.create_task(shoot_all(url, kill))
            await asyncio.wait({shooting, asyncio.create_task(kill.wait())}, return_when=asyncio.FIRST_COMPLETED)
            working.cancel()
            cluster.kill(0)
            await shooting
        await nc.close()


if __name__ == "__main__":
    asyncio.run(main())
