"""The page of a fleet in a real Chromium, of what is published over the real nats-server."""

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncIterator, Iterator
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
from bms_estimator.fleet.nats.streams import make_streams
from bms_estimator.fleet.packs.pack_bucket import PackBucket
from bms_estimator.fleet.page import packs
from bms_estimator.fleet.page.fleet_page import FILES, STATIC, fleet_page
from bms_estimator.fleet.page.nats_feed import FleetFeed, Server
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.model.errors import UserError
from bms_estimator.model.input_faults import InputFault
from bms_estimator.settings.page import PageSettings
from tests.fleet.engine import Engine, connected, running
from tests.fleet.fleets import BEGIN, FIRST_STD, capacities, write_fleet
from tests.fleet.many_packs import HOME, VAN, Pack, beat, load, publish, state
from tests.free_port import free_port
from tests.page.chromium import Tab, chromium, tab
from tests.page.house import starting
from tests.patience import LONG_S
from tests.sinks.snapshots import ONE

in_module = pytest.mark.asyncio(loop_scope="module")
module_fixture = pytest_asyncio.fixture(loop_scope="module", scope="module")

PARTITIONS = 8
STEP_S = 0.05
MAX_BYTES = 60_000
"""Of all that a browser is given."""
PACKS = [
    Pack("home-1", HOME, state(soc=0.653, soc_std=0.012, stability_margin=0.6)),
    Pack("home-2", HOME, state(soc=0.041, soc_std=0.02, stability_margin=-0.013)),
    Pack("van-1", VAN, state(soc=0.9, soc_std=0.071, stability_margin=0.8)),
]
LISTED_ONLY = Pack("van-2", VAN, b"")
NASTY = "<img/src=x>"


class Fleet(NamedTuple):
    """All that runs."""

    engine: Engine
    nc: Client
    url: str
    """Of the page."""


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    with running(tmp_path_factory.mktemp("engine"), partitions=PARTITIONS) as started:
        yield started


@module_fixture
async def browser() -> AsyncIterator[Browser]:
    async with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def hours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve packs that lose 6 % of their capacity in a year, but one that has half the capacity of the others."""
    folder, rng = tmp_path_factory.mktemp("hours"), np.random.default_rng(1)
    truth = np.full((12, 1), -0.02) - 0.06 * np.arange(30) / 365.25
    truth[0] -= 0.7
    ratio, variance = (
        np.exp(values) if i == 0 else values for i, values in enumerate(capacities(rng, truth, 0.01, 1.0))
    )
    write_fleet(
        folder, BEGIN + 24 * np.arange(30) + 23, capacity_ratio=ratio, capacity_ratio_std=ratio * np.sqrt(variance),
        capacity_first_std=FIRST_STD, charge_out_ah=3.0,
    )  # fmt: skip
    return folder


@module_fixture
async def fleet(engine: Engine, hours: Path) -> AsyncIterator[Fleet]:
    nc = await connected(engine.url)
    await make_streams(nc, partitions=PARTITIONS)
    await load(nc, [*PACKS, LISTED_ONLY])
    settings = PageSettings(listen="127.0.0.1:0")
    async with fleet_page(Server(engine.url), settings, hours, step_s=STEP_S) as url:
        working = asyncio.create_task(work(nc))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(packs, "ALIVE_S", math.inf)  # however long it lasts, van-2 is not heard, but not silent
            yield Fleet(engine, nc, url)
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)
    await nc.close()


async def work(nc: Client) -> None:
    """Two workers hold all partitions but the last; packs are heard, one of them is unknown."""
    blocks = 0
    while True:
        with contextlib.suppress(nats.errors.Error, OSError):
            blocks += 1
            await beat(nc, "alpha", range(4), packs=2, blocks=blocks, samples=60 * blocks, lag_s=0.42, unknown_count=1)
            await beat(nc, "beta", range(4, PARTITIONS - 1), packs=1, lag_s=0.1, trouble="no checkpoint")
            for pack in PACKS:
                await publish(nc, pack.name, pack.state)
            await nc.publish(subjects.unknown(NASTY), b"no <b>row</b>")
            await nc.publish(subjects.hours("van-1"), json.dumps({"suspects": int(InputFault.OFFSET)}).encode())
            await nc.publish("bms.home-1.parameters", ONE.parameters.model_dump_json().encode())
        await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def looking(browser: Browser, fleet: Fleet, at: str = "") -> AsyncIterator[Tab]:
    async with tab(browser, f"{fleet.url}{at}") as opened:
        await opened.until_status("live")
        await opened.until_text("known", "of 4")
        await opened.until_text("alive", "3")
        yield opened


@in_module
async def test_the_fleet_is_seen_at_a_glance(browser: Browser, fleet: Fleet) -> None:
    async with looking(browser, fleet) as opened:
        await opened.until_text("partitions", "of 8")
        await opened.until_text("attention", "3")
        await opened.until_text("held", "7")
        await opened.until_text("unheld", "unheld: 7")
        await opened.until_text("lag", "0.4 s")
        page = opened.page
        await page.locator('[data-q="silent"]', has_text="1 not heard yet").wait_for()
        await page.get_by_role("img", name="8 partitions: 7 held by nobody").wait_for()
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
        await opened.until(
            "texts => texts.every((text) => document.getElementById('workers').innerText.includes(text))",
            ["alpha\t4\t2\t0.4 s", "no checkpoint"],
        )
        assert opened.errors == []
        assert all(url.startswith(fleet.url) for url in opened.requests), opened.requests


@in_module
async def test_who_needs_attention_is_ranked_and_names_are_no_markup(browser: Browser, fleet: Fleet) -> None:
    async with looking(browser, fleet) as opened:
        page = opened.page
        wanted = [
            "home-2 Small margin stability margin −1.3 % Low SOC SOC 4.1 %",  # noqa: RUF001 - as shown
            "van-1 Suspected offset Uncertain SOC known to ± 14.2 %",
            f"{NASTY} Unknown its blocks are held: no <b>row</b>",
        ]
        rows: list[str] = []
        with contextlib.suppress(TimeoutError):  # a pack's reasons come one after the other
            async with asyncio.timeout(LONG_S):
                while rows != wanted:
                    rows = [" ".join(text.split()) for text in await page.locator("#concerns tr").all_inner_texts()]
                    await asyncio.sleep(STEP_S)
        assert rows == wanted
        assert await page.locator("#concerns img").count() == 0
        await page.locator("[data-count=soc]").click()
        first = page.locator("#concerns tr").first
        await opened.until("() => document.querySelector('#concerns th').textContent === 'home-2'")
        assert await page.locator("#concerns tr").count() == 3  # the lowest, whether or not they need attention
        assert await page.locator("#concerns tr.mild").count() == 2
        assert "SOC 4.1 %" in await first.inner_text()
        assert opened.errors == []


@in_module
async def test_a_pack_is_found_by_how_its_name_begins_with_the_keyboard_alone(browser: Browser, fleet: Fleet) -> None:
    async with looking(browser, fleet) as opened:
        page = opened.page
        await page.keyboard.press("Tab")
        await page.keyboard.type("home")
        await opened.until("() => document.querySelectorAll('#found button').length === 2")
        await page.keyboard.press("ArrowDown")
        await page.keyboard.press("Enter")
        await page.get_by_role("dialog", name="home-1").wait_for()
        await page.get_by_text("State of charge65.3 %").wait_for()
        assert page.url.endswith("#home-1")
        heard = await page.inner_text("#packwhat")
        assert heard.startswith("lfp 16s1p 280 Ah · heard")
        await opened.until(
            "rows => document.querySelectorAll('#parameters tr').length === rows",
            len(ONE.parameters.elements) + len(ONE.parameters.state_of_health),
        )
        await page.keyboard.press("Escape")
        await page.get_by_role("dialog").wait_for(state="hidden")
        await opened.until("() => location.hash === ''")
        await page.fill("#prefix", "nobody")
        await page.get_by_text("No pack's name begins so.").wait_for()
        await page.fill("#prefix", LISTED_ONLY.name)
        await page.locator("#found button").click()
        await page.get_by_text("ncr18650 14s10p · not heard yet since this page is served").wait_for()
        assert opened.errors == []


@in_module
async def test_what_the_hours_answer_is_seen(browser: Browser, fleet: Fleet) -> None:
    async with looking(browser, fleet) as opened:
        answers = opened.page.locator("#answers")
        text = await answers.locator("[data-answer=soh] tbody").inner_text()
        assert text.startswith("ncr18650 1s1p 3 Ah\t12\t")
        outlier = answers.locator("[data-answer=outliers] tbody tr")
        assert (await outlier.inner_text()).startswith("p0\tcapacity ratio\t")
        await outlier.get_by_role("button", name="p0").click()
        await opened.page.get_by_role("dialog", name="p0").wait_for()
        await opened.page.get_by_text("Nothing was heard of this pack yet").wait_for()
        assert await answers.locator("[data-answer=honest]").count() == 1
        assert [error for error in opened.errors if "404" not in error] == []


@in_module
async def test_nothing_is_wider_than_the_screen(browser: Browser, fleet: Fleet) -> None:
    wider = """width => [...document.querySelectorAll("body, header *, #fleet, .card, .card :not(.scroll *)")]
        .filter((e) => e.getBoundingClientRect().right > width + 0.5).map((e) => e.outerHTML.slice(0, 80))"""
    async with looking(browser, fleet) as opened:
        await opened.until("() => document.querySelectorAll('#concerns tr').length === 3")
        for width, height in ((320, 600), (390, 844), (768, 1024), (1920, 1080)):
            await opened.page.set_viewport_size({"width": width, "height": height})
            assert await opened.page.evaluate(wider, width) == []


@in_module
async def test_it_is_stale_while_the_server_is_away_and_comes_back_by_itself(browser: Browser, fleet: Fleet) -> None:
    async with looking(browser, fleet) as opened:
        fleet.engine.kill(0)
        await opened.until_status("stale since")
        assert (await opened.page.inner_text("#why")).startswith(f"{fleet.engine.url}: ")
        assert await opened.text("alive") == "3"
        fleet.engine.start(0)
        await opened.until_status("live")
        await opened.until_text("alive", "3")
        await opened.until_text("held", "7")
        assert await opened.page.inner_text("#why") == ""
        late = await nats.connect(fleet.engine.url)  # a connection that was cut may take its time
        await load(late, [Pack("late-1", HOME, b"")])
        await late.close()
        await opened.until_text("known", "of 5")


@in_module
async def test_it_is_answered_under_names_of_ours_alone(fleet: Fleet) -> None:
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


def test_all_that_a_browser_is_given_is_small_and_comes_from_here() -> None:
    assert {file.path for file in FILES.values()} >= set(STATIC.iterdir())
    assert sum(file.path.stat().st_size for file in FILES.values()) <= MAX_BYTES
    own = [path.read_text() for path in STATIC.iterdir()]
    assert not any("http://" in text or "https://" in text for text in own)


@in_module
async def test_the_command_serves_until_it_is_told_to_end(fleet: Fleet, tmp_path: Path) -> None:
    port = free_port()
    arguments = ("--server", fleet.engine.url, "--listen", f"127.0.0.1:{port}", "--no-browser")
    process = await starting(tmp_path, "fleet", "page", *arguments, port=port)
    async with aiohttp.ClientSession() as session, session.get(f"http://127.0.0.1:{port}/") as response:
        assert response.status == 200
    process.terminate()
    assert await process.wait() == 0


@in_module
async def test_credentials_that_are_not_there_are_said() -> None:
    with pytest.raises(UserError, match=r"--creds no\.creds: cannot be read: No such file"):
        FleetFeed(Server("nats://127.0.0.1:1", Path("no.creds")), FleetView(1, 0.0), lambda _: None)


@in_module
async def test_a_server_that_is_not_there_is_said_and_waited_for() -> None:
    said = asyncio.Queue[str | None]()
    url = f"nats://127.0.0.1:{free_port()}"
    async with FleetFeed(Server(url), FleetView(1, 0.0), said.put_nowait):
        assert await said.get() == f"{url}: not reached yet"
        assert await said.get() == f"{url}: nobody listens there"


@in_module
async def test_it_ends_though_the_library_swallows_that_it_is_cancelled(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, swallowed = asyncio.Event(), asyncio.Event()

    async def refresh(_: PackBucket) -> set[str]:
        asked.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:  # as wait_for of Python 3.11 does when the answer comes at that moment
            swallowed.set()
        return set()

    monkeypatch.setattr(PackBucket, "refresh", refresh)
    async with (
        asyncio.timeout(LONG_S),
        FleetFeed(Server(fleet.engine.url), FleetView(PARTITIONS, 0.0), lambda _: None),
    ):
        await asked.wait()
    assert swallowed.is_set()


@in_module
async def test_why_nothing_more_is_heard_is_said(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    said = asyncio.Queue[str | None]()

    async def until(wanted: str) -> None:
        async with asyncio.timeout(LONG_S):
            while wanted not in (await said.get() or ""):
                pass

    async def refresh(_: PackBucket) -> set[str]:
        raise KeyError

    async with FleetFeed(Server(fleet.engine.url), FleetView(PARTITIONS, 0.0), said.put_nowait) as feed:
        while await said.get() is not None:
            pass
        assert feed._nc
        await feed._nc.close()  # as it is when the server puts somebody out
        await until("the server has closed the connection: look at --creds")
    monkeypatch.setattr(PackBucket, "refresh", refresh)
    async with FleetFeed(Server(fleet.engine.url), FleetView(PARTITIONS, 0.0), said.put_nowait):
        await until("a fault of the page")


@in_module
async def test_what_the_last_hour_said_before_the_page_was_there_is_read(fleet: Fleet) -> None:
    hour = json.dumps({"suspects": int(InputFault.OCV)}).encode()
    late = await nats.connect(fleet.engine.url)
    await late.jetstream(timeout=LONG_S).publish(subjects.hours("early-1"), hour)
    await late.close()
    view = FleetView(1, 0.0)
    async with FleetFeed(Server(fleet.engine.url), view, lambda _: None), asyncio.timeout(LONG_S):
        while not (view.packs.find("early") and view.workers.partitions == PARTITIONS):  # noqa: ASYNC110 - nobody tells
            await asyncio.sleep(0.01)
    shown = view.picture(0.0, 0.0)
    assert ["early-1", "ocv"] in shown["concerns"]["suspects"]["packs"]
