"""Fleet page in a real Chromium, with messages from the real nats-server."""

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import aiohttp
import nats
import numpy as np
import pytest
import pytest_asyncio
from nats.aio.client import Client
from playwright.async_api import Browser

from bms_estimator.edge import subjects
from bms_estimator.fleet.heartbeat import RefusedPartition
from bms_estimator.fleet.nats.dead_letters import DeadLetter, read_dead_letters, replay_letter
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.page import nats_feed, packs
from bms_estimator.fleet.page.fleet_page import FILES, STATIC, fleet_page
from bms_estimator.fleet.page.nats_feed import FleetFeed, Server
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.connections import PageSettings
from tests.fleet.hour_rows import BEGIN, FIRST_STD, estimate_capacities, write_fleet
from tests.fleet.nats_cluster import NatsCluster, connected, running
from tests.fleet.published_states import HOME, VAN, Pack, load, publish, publish_heartbeat, state
from tests.free_port import free_port
from tests.page.chromium import Tab, chromium, tab
from tests.page.house import start_program
from tests.patience import LONG_S
from tests.sinks.snapshots import CELL_SNAPSHOT

in_module = pytest.mark.asyncio(loop_scope="module")
module_fixture = pytest_asyncio.fixture(loop_scope="module", scope="module")

PARTITIONS = 8
OVERVIEW_S = 0.05
"""Update interval of the page [s]."""
MAX_BYTES = 60_000
"""Maximum total size of the served files [bytes]."""
PACKS = [
    Pack("home-1", HOME, state(soc=0.653, soc_std=0.012, stability_margin=0.6)),
    Pack("home-2", HOME, state(soc=0.041, soc_std=0.02, stability_margin=-0.013)),
    Pack("van-1", VAN, state(soc=0.9, soc_std=0.071, stability_margin=0.8)),
]
LISTED_ONLY = Pack("van-2", VAN, b"")
"""Pack in the table of packs that publishes no state."""
MARKUP_NAME = "<img/src=x>"
"""Name of a pack that would be an image if the page did not escape it."""


class Fleet(NamedTuple):
    """Running server, its connection, and the page."""

    cluster: NatsCluster
    nc: Client
    url: str
    """URL of the page."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsCluster]:
    with running(tmp_path_factory.mktemp("cluster"), partitions=PARTITIONS) as started:
        yield started


@module_fixture
async def browser() -> AsyncIterator[Browser]:
    async with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def hours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with hour rows of twelve packs that lose 6 % of their capacity in a year.

    One pack has half the capacity of the others.
    """
    folder, rng = tmp_path_factory.mktemp("hours"), np.random.default_rng(1)
    truth = np.full((12, 1), -0.02) - 0.06 * np.arange(30) / 365.25  # ln(capacity) of 30 days
    truth[0] -= 0.7
    ratio, variance = (
        np.exp(values) if i == 0 else values
        for i, values in enumerate(estimate_capacities(rng, truth, std=0.01, daily_throughput=1.0))
    )
    write_fleet(
        folder, BEGIN + 24 * np.arange(30) + 23, capacity_ratio=ratio, capacity_ratio_std=ratio * np.sqrt(variance),
        capacity_first_std=FIRST_STD, charge_out_ah=3.0,
    )  # fmt: skip
    return folder


@module_fixture
async def fleet(cluster: NatsCluster, hours: Path) -> AsyncIterator[Fleet]:
    nc = await connected(cluster.url)
    await make_streams(nc, partitions=PARTITIONS)
    await load(nc, [*PACKS, LISTED_ONLY])
    await store_dead_letter(nc, "home-1")
    settings = PageSettings(listen="127.0.0.1:0")
    async with fleet_page(Server(cluster.url), settings, hours, overview_s=OVERVIEW_S) as url:
        publisher_task = asyncio.create_task(work(nc))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(packs, "SILENT_S", math.inf)  # van-2 has no state, but must not become silent
            yield Fleet(cluster, nc, url)
        publisher_task.cancel()
        await asyncio.gather(publisher_task, return_exceptions=True)
    await nc.close()


async def store_dead_letter(nc: Client, pack: str) -> None:
    letter = DeadLetter(pack, 1, "version 2", "beta", b"a block")
    await nc.jetstream().publish(letter.subject, letter.data, headers=letter.headers())


async def work(nc: Client) -> None:
    """Publish what two workers would that hold all partitions but one, until cancelled. One pack is unknown."""
    blocks = 0
    while True:
        with contextlib.suppress(nats.errors.Error, OSError):
            blocks += 1
            await publish_heartbeat(
                nc, "alpha", range(4), packs=2, blocks=blocks, samples=60 * blocks, lag_s=0.42, unknown_count=1
            )
            await publish_heartbeat(
                nc,
                "beta",
                range(4, PARTITIONS - 1),
                packs=1,
                lag_s=0.1,
                trouble="no checkpoint",
                refused=(RefusedPartition(partition=PARTITIONS - 1, format=3),),
            )
            for pack in PACKS:
                await publish(nc, pack.name, pack.state)
            await nc.publish(subjects.unknown(MARKUP_NAME), b"no <b>row</b>")
            await nc.publish(subjects.hours("van-1"), json.dumps({"suspects": int(InputFault.OFFSET)}).encode())
            await nc.publish("bms.home-1.parameters", CELL_SNAPSHOT.parameters.model_dump_json().encode())
        await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def open_page(browser: Browser, fleet: Fleet, fragment: str = "") -> AsyncIterator[Tab]:
    """Open the page in a tab, and wait until it shows all packs."""
    async with tab(browser, f"{fleet.url}{fragment}") as browser_tab:
        await browser_tab.until_status("live")
        await browser_tab.until_text("known", "of 4")
        await browser_tab.until_text("alive", "3")
        yield browser_tab


@in_module
async def test_overview_has_counts_and_distributions(browser: Browser, fleet: Fleet) -> None:
    async with open_page(browser, fleet) as browser_tab:
        await browser_tab.until_text("partitions", "of 8")
        await browser_tab.until_text("attention", "4")
        await browser_tab.until_text("held", "7")
        await browser_tab.until_text("unheld", "unreadable checkpoints: 7")
        await browser_tab.until_text("lag", "0.4 s")
        page = browser_tab.page
        await page.locator('[data-q="silent"]', has_text="1 not heard yet").wait_for()
        await page.get_by_role("img", name="8 partitions: 7 not held").wait_for()
        await page.get_by_role(
            "img", name="State of charge: 1 pack 0 to 5 %, 1 pack 65 to 70 %, 1 pack 90 to 95 %"
        ).wait_for()
        await page.get_by_role(
            "img", name="Uncertainty: 1 pack ± 2 to 4 %, 1 pack ± 4 to 6 %, 1 pack ± 12 to 16 %"
        ).wait_for()
        assert (
            await page.inner_text("#types")
            == "lfp 16s1p 280 Ah\t2\t2\t34.7 %\t3.2 %\nncr18650 14s10p\t2\t1\t90.0 %\t14.2 %"
        )
        await page.get_by_role("button", name="ncr18650 14s10p").click()
        await page.get_by_role("img", name="State of charge: 1 pack 90 to 95 %").wait_for()
        await browser_tab.until(
            "texts => texts.every((text) => document.getElementById('workers').innerText.includes(text))",
            ["alpha\t4\t2\t0.4 s", "no checkpoint", "refuses partition 7: checkpoint format 3, reads 1"],
        )
        assert browser_tab.errors == []
        assert all(url.startswith(fleet.url) for url in browser_tab.requests), browser_tab.requests


@in_module
async def test_packs_with_concerns_are_ranked_and_names_are_escaped(browser: Browser, fleet: Fleet) -> None:
    async with open_page(browser, fleet) as browser_tab:
        page = browser_tab.page
        expected = [
            "home-2 Small margin stability margin −1.3 % Low SOC SOC 4.1 %",  # noqa: RUF001 - as overview
            "van-1 Suspected offset",
            "home-1 Dead letters blocks could not be processed: version 2",
            f"{MARKUP_NAME} Unknown its blocks are held: no <b>row</b>",
        ]
        rows: list[str] = []
        with contextlib.suppress(TimeoutError):  # the concerns of a pack arrive one after the other
            async with asyncio.timeout(LONG_S):
                while rows != expected:
                    rows = [" ".join(text.split()) for text in await page.locator("#concerns tr").all_inner_texts()]
                    await asyncio.sleep(OVERVIEW_S)
        assert rows == expected
        assert await page.locator("#concerns img").count() == 0
        await page.locator("[data-count=soc]").click()
        first = page.locator("#concerns tr").first
        await browser_tab.until("() => document.querySelector('#concerns th').textContent === 'home-2'")
        assert await page.locator("#concerns tr").count() == 3  # the lowest values, also without a concern
        assert await page.locator("#concerns tr.mild").count() == 2
        assert "SOC 4.1 %" in await first.inner_text()
        assert browser_tab.errors == []


@in_module
async def test_pack_is_found_by_its_prefix_and_opened_with_the_keyboard(browser: Browser, fleet: Fleet) -> None:
    async with open_page(browser, fleet) as browser_tab:
        page = browser_tab.page
        await page.keyboard.press("Tab")
        await page.keyboard.type("home")
        await browser_tab.until("() => document.querySelectorAll('#found button').length === 2")
        await page.keyboard.press("ArrowDown")
        await page.keyboard.press("Enter")
        await page.get_by_role("dialog", name="home-1").wait_for()
        await page.get_by_text("State of charge65.3 %").wait_for()
        assert page.url.endswith("#home-1")
        details = await page.inner_text("#packwhat")
        assert details.startswith("lfp 16s1p 280 Ah · last message")
        await browser_tab.until(
            "rows => document.querySelectorAll('#parameters tr').length === rows",
            len(CELL_SNAPSHOT.parameters.elements) + len(CELL_SNAPSHOT.parameters.state_of_health),
        )
        await page.keyboard.press("Escape")
        await page.get_by_role("dialog").wait_for(state="hidden")
        await browser_tab.until("() => location.hash === ''")
        await page.fill("#prefix", "nobody")
        await page.get_by_text("No pack has this prefix.").wait_for()
        await page.fill("#prefix", LISTED_ONLY.name)
        await page.locator("#found button").click()
        await page.get_by_text("ncr18650 14s10p · no message since the start of this page").wait_for()
        assert browser_tab.errors == []


@in_module
async def test_results_of_the_queries_are_shown_and_lead_to_packs(browser: Browser, fleet: Fleet) -> None:
    async with open_page(browser, fleet) as browser_tab:
        answers = browser_tab.page.locator("#answers")
        text = await answers.locator("[data-answer=soh] tbody").inner_text()
        assert text.startswith("ncr18650 1s1p 3 Ah\t12\t")
        assert (await browser_tab.page.locator(".card:visible").first.inner_text()).startswith("About to fail")
        outlier = answers.locator("[data-answer=outliers] tbody tr")
        assert (await outlier.inner_text()).startswith("p0\tcapacity ratio\t")
        await outlier.get_by_role("button", name="p0").click()
        await browser_tab.page.get_by_role("dialog", name="p0").wait_for()
        await browser_tab.page.get_by_text("Nothing was heard of this pack yet").wait_for()
        assert await answers.locator("[data-answer=honest]").count() == 1
        assert [error for error in browser_tab.errors if "404" not in error] == []


@in_module
async def test_no_element_is_wider_than_the_screen(browser: Browser, fleet: Fleet) -> None:
    overflowing_elements = """width => [...document.querySelectorAll("body, header *, #fleet, .card, .card :not(.scroll *)")]
        .filter((e) => e.getBoundingClientRect().right > width + 0.5).map((e) => e.outerHTML.slice(0, 80))"""
    async with open_page(browser, fleet) as browser_tab:
        await browser_tab.until("() => document.querySelectorAll('#concerns tr').length === 4")
        for width, height in ((320, 600), (390, 844), (768, 1024), (1920, 1080)):
            await browser_tab.page.set_viewport_size({"width": width, "height": height})
            assert await browser_tab.page.evaluate(overflowing_elements, width) == []


@in_module
async def test_page_is_stale_without_the_nats_server_and_live_after_its_restart(browser: Browser, fleet: Fleet) -> None:
    async with open_page(browser, fleet) as browser_tab:
        fleet.cluster.kill(0)
        await browser_tab.until_status("stale since")
        assert (await browser_tab.page.inner_text("#why")).startswith(f"{fleet.cluster.url}: ")
        assert await browser_tab.text("alive") == "3"
        fleet.cluster.start(0)
        await browser_tab.until_status("live")
        await browser_tab.until_text("alive", "3")
        await browser_tab.until_text("held", "7")
        assert await browser_tab.page.inner_text("#why") == ""
        other_connection = await nats.connect(fleet.cluster.url)  # the old connection may still be reconnecting
        await load(other_connection, [Pack("late-1", HOME, b"")])
        await other_connection.close()
        await browser_tab.until_text("known", "of 5")


@in_module
async def test_requests_with_another_host_name_are_rejected_and_files_are_served(fleet: Fleet) -> None:
    async with aiohttp.ClientSession(fleet.url) as session:
        for path in (*FILES, "/events", "/packs?prefix=h", "/pack?name=home-1"):
            async with session.get(path, headers={"Host": "evil.example.org"}) as response:
                assert response.status == 403, path
        async with session.get("/pack?name=x") as response:
            assert response.status == 404
        for path, (file, kind) in FILES.items():
            async with session.get(path) as response:
                assert (response.status, response.content_type) == (200, kind)
                assert await response.read() == file.read_bytes()


def test_served_files_are_small_and_refer_to_no_other_host() -> None:
    assert {file.path for file in FILES.values()} >= set(STATIC.iterdir())
    assert sum(file.path.stat().st_size for file in FILES.values()) <= MAX_BYTES
    texts = [path.read_text() for path in STATIC.iterdir()]
    assert not any("http://" in text or "https://" in text for text in texts)


@in_module
async def test_command_serves_until_sigterm(fleet: Fleet, tmp_path: Path) -> None:
    port = free_port()
    arguments = ("--server", fleet.cluster.url, "--listen", f"127.0.0.1:{port}", "--no-browser")
    process = await start_program(tmp_path, "fleet", "page", *arguments, port=port)
    async with aiohttp.ClientSession() as session, session.get(f"http://127.0.0.1:{port}/") as response:
        assert response.status == 200
    process.terminate()
    assert await process.wait() == 0


@in_module
async def test_missing_credentials_file_is_a_user_error() -> None:
    with pytest.raises(UserError, match=r"--creds no\.creds: cannot be read: No such file"):
        FleetFeed(Server("nats://127.0.0.1:1", Path("no.creds")), FleetView(1, 0.0), lambda _: None)


@in_module
async def test_unreachable_server_is_reported_and_retried() -> None:
    changes = asyncio.Queue[str | None]()
    url = f"nats://127.0.0.1:{free_port()}"
    async with FleetFeed(Server(url), FleetView(1, 0.0), changes.put_nowait):
        assert await changes.get() == f"{url}: not reached yet"
        assert await changes.get() == f"{url}: connection refused: no server listens on this address"


def replace_refresh(
    monkeypatch: pytest.MonkeyPatch, feed: FleetFeed, refresh: Callable[[], Awaitable[set[str]]]
) -> None:
    """Replace the poll of the table in one feed. The page of the module has another feed in this process."""
    original = PackBucket.refresh

    async def refresh_of_feed(bucket: PackBucket) -> set[str]:
        return await (refresh() if bucket._nc is feed._nc else original(bucket))

    monkeypatch.setattr(PackBucket, "refresh", refresh_of_feed)


@in_module
async def test_feed_ends_although_the_library_swallows_a_cancellation(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    refreshing, swallowed = asyncio.Event(), asyncio.Event()

    async def refresh() -> set[str]:
        refreshing.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:  # wait_for of Python 3.11 swallows it if the response arrives now
            swallowed.set()
        return set()

    feed = FleetFeed(Server(fleet.cluster.url), FleetView(PARTITIONS, 0.0), lambda _: None)
    replace_refresh(monkeypatch, feed, refresh)
    async with asyncio.timeout(LONG_S), feed:
        await refreshing.wait()
    assert swallowed.is_set()


@in_module
async def test_closed_connection_and_internal_error_of_the_feed_are_reported(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = asyncio.Queue[str | None]()

    async def until(expected: str) -> None:
        async with asyncio.timeout(LONG_S):
            while expected not in (await changes.get() or ""):
                pass

    async def refresh() -> set[str]:
        raise KeyError

    async with FleetFeed(Server(fleet.cluster.url), FleetView(PARTITIONS, 0.0), changes.put_nowait) as feed:
        while await changes.get() is not None:  # until it is connected
            pass
        assert feed._nc
        await feed._nc.close()  # as if the server had closed the connection permanently
        await until("the server has closed the connection: check --creds")
    feed = FleetFeed(Server(fleet.cluster.url), FleetView(PARTITIONS, 0.0), changes.put_nowait)
    replace_refresh(monkeypatch, feed, refresh)
    async with feed:
        await until("internal error of the page")


@in_module
async def test_hour_rows_published_before_the_start_of_the_page_are_read(fleet: Fleet) -> None:
    hour = json.dumps({"suspects": int(InputFault.OCV)}).encode()
    other_connection = await nats.connect(fleet.cluster.url)
    await other_connection.jetstream(timeout=LONG_S).publish(subjects.hours("early-1"), hour)
    await other_connection.close()
    view = FleetView(1, 0.0)
    async with FleetFeed(Server(fleet.cluster.url), view, lambda _: None), asyncio.timeout(LONG_S):
        while not (view.packs.find("early") and view.workers.partitions == PARTITIONS):  # noqa: ASYNC110 - the view has no notifications
            await asyncio.sleep(0.01)
    overview = view.overview(0.0, 0.0)
    assert ["early-1", "ocv"] in overview["concerns"]["suspects"]["packs"]


@in_module
async def test_pack_has_a_dead_letter_on_the_page_until_it_is_replayed(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nats_feed, "TABLE_S", 0.05)
    view = FleetView(1, 0.0)
    connection = await nats.connect(fleet.cluster.url)
    await store_dead_letter(connection, "van-1")
    async with FleetFeed(Server(fleet.cluster.url), view, lambda _: None), asyncio.timeout(LONG_S):
        for names in (["home-1", "van-1"], ["home-1"]):
            while [pack for pack, _ in view.dead_packs.reasons] != names:  # noqa: ASYNC110 - the view has no notifications
                await asyncio.sleep(0.01)
            assert view.dead_packs.packs == len(names)
            for letter in await read_dead_letters(connection):
                if letter.pack == "van-1":
                    await replay_letter(connection, letter)
    await connection.close()
