"""Report in a browser: screen, phone and paper."""

import pytest

from tests.page.chromium import PHONE, chromium, tab
from tests.reports.screenshots import PAPER, make_report, take_screenshots


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return make_report(tmp_path_factory.mktemp("report"))


@pytest.mark.parametrize("size", [{"width": 1280, "height": 800}, PHONE, PAPER])
async def test_report_needs_no_horizontal_scrolling_and_loads_nothing(report, size):
    async with chromium() as browser, tab(browser, report.as_uri(), size=size) as page_tab:
        if size is PAPER:
            await page_tab.page.emulate_media(media="print")
        width = await page_tab.page.evaluate("document.documentElement.scrollWidth")
        assert width <= size["width"]
        assert page_tab.requests == [report.as_uri()]
        assert page_tab.errors == []


async def test_text_is_large_enough_on_a_phone(report):
    """Texts have at least 13 px, and figures are shown at no less than 70 % of their size, in which texts have 12 px."""
    async with chromium() as browser, tab(browser, report.as_uri(), size=PHONE) as page_tab:
        smallest_px, scale = await page_tab.page.evaluate("""() => [
            Math.min(...[...document.querySelectorAll("main p, main td, main th")]
                .map(each => parseFloat(getComputedStyle(each).fontSize))),
            Math.min(...[...document.querySelectorAll("svg")]
                .map(each => each.getBoundingClientRect().width / (each.viewBox.baseVal.width / 0.75)))]""")
    assert smallest_px >= 13.0
    assert scale >= 0.7


async def test_figures_and_tables_are_not_cut_by_a_page_break(report):
    async with chromium() as browser, tab(browser, report.as_uri(), size=PAPER) as page_tab:
        await page_tab.page.emulate_media(media="print")
        breaks = await page_tab.page.evaluate(
            """() => [...document.querySelectorAll("article, tr")].map(each => getComputedStyle(each).breakInside)"""
        )
        hidden = await page_tab.page.evaluate("""() => getComputedStyle(document.querySelector("nav")).display""")
        document = await page_tab.page.pdf(prefer_css_page_size=True)
    assert set(breaks) == {"avoid"}
    assert hidden == "none"
    assert document.count(b"/Type /Page\n") > 1


async def test_screenshots_of_the_documentation_are_made(report, tmp_path):
    async with chromium() as browser:
        paths = await take_screenshots(browser, report, tmp_path)
    assert [path.name for path in paths] == ["report-desktop.png", "report-phone.png", "report-print.png"]
    assert all(path.stat().st_size > 20_000 for path in paths)
