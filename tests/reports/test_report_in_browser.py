"""Report in a browser: screen, phone and paper."""

from dataclasses import replace

import numpy as np
import pytest
import pytest_asyncio

from bms_estimator.reports.history_report import history_report
from tests.page.chromium import PHONE, chromium, tab
from tests.reports.screenshots import PAPER, make_report, take_screenshots
from tests.reports.test_history_report import history_of

pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def browser():
    async with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return make_report(tmp_path_factory.mktemp("report"))


@pytest.mark.parametrize("size", [{"width": 1280, "height": 800}, PHONE, PAPER])
async def test_report_needs_no_horizontal_scrolling_and_loads_nothing(browser, report, size):
    async with tab(browser, report.as_uri(), size=size) as page_tab:
        if size is PAPER:
            await page_tab.page.emulate_media(media="print")
        width = await page_tab.page.evaluate("document.documentElement.scrollWidth")
        assert width <= size["width"]
        assert page_tab.requests == [report.as_uri()]
        assert page_tab.errors == []


async def test_text_is_large_enough_on_a_phone(browser, report):
    """Texts have at least 13 px, and figures are shown at no less than 70 % of their size, in which texts have 12 px."""
    async with tab(browser, report.as_uri(), size=PHONE) as page_tab:
        smallest_px, scale = await page_tab.page.evaluate("""() => [
            Math.min(...[...document.querySelectorAll("main p, main td, main th")]
                .map(each => parseFloat(getComputedStyle(each).fontSize))),
            Math.min(...[...document.querySelectorAll("svg")]
                .map(each => each.getBoundingClientRect().width / (each.viewBox.baseVal.width / 0.75)))]""")
    assert smallest_px >= 13.0
    assert scale >= 0.7


async def test_figures_and_tables_are_not_cut_by_a_page_break(browser, report):
    async with tab(browser, report.as_uri(), size=PAPER) as page_tab:
        await page_tab.page.emulate_media(media="print")
        breaks = await page_tab.page.evaluate(
            """() => [...document.querySelectorAll("article, tr")].map(each => getComputedStyle(each).breakInside)"""
        )
        hidden = await page_tab.page.evaluate("""() => getComputedStyle(document.querySelector("nav")).display""")
        document = await page_tab.page.pdf(prefer_css_page_size=True)
    assert set(breaks) == {"avoid"}
    assert hidden == "none"
    assert document.count(b"/Type /Page\n") > 1


@pytest.fixture
def history_page(tmp_path):
    """Return the page on a history of 30 days with 30 events."""
    text = (
        "sensor_fault: samples are lost, unusable or from two publishers: 58.96 %, limit 10 %; check sensors and wiring"
    )
    events = [(3600.0 * hour, "alarm_raised", text) for hour in range(30)]
    history = replace(history_of(3600.0 * np.arange(30 * 24)), events=events)
    path = tmp_path / "history.html"
    path.write_text(history_report(history, "2026-01-01").html(), encoding="utf-8")
    return path


async def test_events_are_readable_on_a_phone_without_scrolling(browser, history_page):
    async with tab(browser, history_page.as_uri(), size=PHONE) as page_tab:
        widths = await page_tab.page.evaluate(
            """() => [...document.querySelectorAll(".text")].map(each => each.getBoundingClientRect().right)"""
        )
    assert len(widths) == 2
    assert max(widths) <= PHONE["width"]


async def test_long_tables_continue_on_the_next_page(browser, history_page):
    async with tab(browser, history_page.as_uri(), size=PAPER) as page_tab:
        await page_tab.page.emulate_media(media="print")
        breaks = await page_tab.page.evaluate("""() => [...document.querySelectorAll("article.table")].map(each =>
            [each.querySelectorAll("tbody tr").length, getComputedStyle(each).breakInside])""")
    assert breaks == [[30, "auto"], [30, "auto"], [5, "avoid"]]


@pytest.mark.thorough
async def test_screenshots_of_the_documentation_are_made(browser, report, tmp_path):
    paths = await take_screenshots(browser, report, tmp_path)
    assert [path.name for path in paths] == ["report-desktop.png", "report-phone.png", "report-print.png"]
    assert all(path.stat().st_size > 20_000 for path in paths)
