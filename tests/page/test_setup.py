"""The setup page in a real Chromium, with a simulated BMS: from the search to the first estimate."""

import asyncio
import re
from pathlib import Path

import pytest
from aiohttp import ClientSession
from playwright.async_api import Page, expect

from bms_estimator.settings.connections import PageSettings
from bms_estimator.settings.pack import load_settings
from bms_estimator.setup.page.setup_server import SetupServer
from bms_estimator.simulation.simulated_pack import SimulatedBms
from bms_estimator.simulation.virtual_adc import Reading
from tests.command_line import error, run
from tests.device_line import running_device
from tests.mosquitto import PASSWORD, password_broker
from tests.page.chromium import DESKTOP, PHONE, chromium, tab
from tests.patience import LONG_S

TOKEN = "0123456789abcdef"


@pytest.fixture(autouse=True)
def long_timeouts(monkeypatch):
    """Shorten the wait for a board, and lengthen other timeouts."""
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.BOOT_TIMEOUT_S", 0.1)
    monkeypatch.setattr("bms_estimator.sources.serial.device_detection.PROTOCOL_TIMEOUT_S", LONG_S)
    monkeypatch.setattr("bms_estimator.setup.measurement.FIRST_SAMPLE_TIMEOUT_S", LONG_S)
    expect.set_options(timeout=1e3 * LONG_S)


def loopback(**options: object) -> PageSettings:
    return PageSettings.model_validate({"listen": "127.0.0.1:0", **options})


async def search_and_choose(page: Page, path: str) -> None:
    """Search one port, and choose the BMS that is found there."""
    await page.get_by_label("Where to search").fill(path)
    await page.get_by_role("button", name="Search", exact=True).click()
    await expect(page.get_by_role("button", name="Use this device")).to_be_visible()
    await page.get_by_role("button", name="Use this device").click()
    await expect(page.get_by_text("52.80 V, 35.00 A, discharging")).to_be_visible()


@pytest.mark.parametrize(
    ("size", "device_soc_std", "first_estimate"),
    [
        (PHONE, "none", r"State of charge\s+not known yet\s+Charge the pack to full once"),
        pytest.param(DESKTOP, "10", r"State of charge\s+\d+\.\d\s*%\s+± \d", marks=pytest.mark.thorough),
    ],
    ids=["phone", "desktop"],
)
async def test_page_leads_from_the_search_to_the_first_estimate(
    tmp_path: Path, size: dict[str, int], device_soc_std: str, first_estimate: str
) -> None:
    file = tmp_path / "house.toml"
    bms = SimulatedBms("jk", lambda _: Reading(35.0, 52.8, 21.0), cells=16, soc=lambda: 0.62, capacity_ah=280.0)
    with running_device(bms) as path:
        async with (
            SetupServer(loopback(), file) as server,
            chromium() as browser,
            tab(browser, server.url, size=size) as opened,
        ):
            await search_and_choose(opened.page, path)
            await compare_voltage(opened.page)
            await answer_questions(opened.page, device_soc_std)
            await expect(opened.page.locator("[data-q=voltage]")).to_have_text("53.33")
            await expect(opened.page.locator(".card").first).to_have_text(
                re.compile(first_estimate), use_inner_text=True
            )
            await expect(opened.page.get_by_text("A first estimate under load is inexact")).to_be_visible()
            await expect(opened.page.get_by_text(f"bms-estimator run {file}")).to_be_visible()
            overflow = await opened.page.evaluate("document.documentElement.scrollWidth - innerWidth")
    assert overflow <= 0, "a part of the page is outside the screen"
    assert opened.errors == []
    pack, sensor = load_settings(file).pack, load_settings(file).sensor
    assert (pack.name, pack.cell, pack.series, sensor.voltage_gain) == ("house", "lfp", 16, pytest.approx(1.01))


async def compare_voltage(page: Page) -> None:
    """Enter an impossible voltage, which is rejected with the reason, and then a possible one."""
    await page.get_by_label("Voltage at the terminals").fill("5.28")
    await page.get_by_role("button", name="Compare voltage").click()
    await expect(page.get_by_role("alert")).to_contain_text("differs by more than 20%")
    await page.get_by_label("Voltage at the terminals").fill("53.328")
    await page.get_by_role("button", name="Compare voltage").click()
    await expect(page.get_by_text("gain 1.0100")).to_be_visible()
    await page.get_by_role("button", name="Check the sign").click()
    await expect(page.get_by_text("current: the sign is right")).to_be_visible()


async def answer_questions(page: Page, device_soc_std: str = "10") -> None:
    """Enter a capacity in mAh and an invalid port, which are rejected with the reasons, and then the right ones."""
    await page.get_by_role("button", name="Continue").click()
    await page.get_by_label("Chemistry").select_option("lfp")
    await page.get_by_label("Capacity of one cell").fill("100000")
    await page.get_by_label("MQTT broker").fill("mqtt://localhost:99999")
    await page.get_by_role("button", name="Write").click()
    await expect(page.get_by_role("alert")).to_contain_text(["is it in mAh?", "Port out of range"])
    await page.get_by_label("Capacity of one cell").fill("280 Ah")
    await page.get_by_label("How far may the SOC").fill(device_soc_std)
    await page.get_by_label("MQTT broker").fill("none")
    await page.get_by_role("button", name="Write").click()


async def page_after(client: ClientSession, server_url: str, path: str, **fields: str) -> str:
    """Submit a form of the page, and return the page after the search that it starts."""

    async def text() -> str:
        async with client.get(server_url) as answer:
            return await answer.text()

    key = re.search('name="form_key" value="([^"]*)"', await text())
    assert key
    await client.post(f"{server_url}{path}", data={**fields, "form_key": key[1]})
    async with asyncio.timeout(LONG_S):
        while "Searching" in (page := await text()):  # noqa: ASYNC110 - the page has no event for this
            await asyncio.sleep(0.01)
    return page


async def test_a_broker_with_a_password_is_searched_after_a_login(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("bms_estimator.setup.search.LISTEN_DURATION_S", 0.5)
    with password_broker(tmp_path) as broker:
        login = {"url": broker.url, "username": "owner"}
        async with SetupServer(loopback(), tmp_path / "pack.toml") as server, ClientSession() as client:
            page = await page_after(client, server.url, "search", places=broker.url)
            assert f"Log in at {broker.url}" in page
            page = await page_after(client, server.url, "login", **login, password="wrong")
            assert "user name or password wrong" in page
            page = await page_after(client, server.url, "login", **login, password=PASSWORD)
            assert f"{broker.url}: no message of a known publisher" in page
            again = re.search(r"rows=\"4\">([^<]*)<", page)
            assert again  # the place without its password, which the server adds again
            page = await page_after(client, server.url, "search", places=again[1])
            assert f"{broker.url}: no message of a known publisher" in page
            assert PASSWORD not in page


async def test_a_failed_search_is_reported_and_can_be_repeated(tmp_path: Path) -> None:
    async with SetupServer(loopback(), tmp_path / "pack.toml") as server, ClientSession() as client:
        page = await page_after(client, server.url, "search", places="gx:0 mqtt://user:secret@gx")
    assert "gx:0: must be a host" in page
    assert "Search again" in page
    assert "secret" not in page


async def test_a_form_of_another_page_changes_nothing(tmp_path: Path) -> None:
    async with SetupServer(loopback(), tmp_path / "pack.toml") as server, ClientSession() as client:
        async with client.post(f"{server.url}search", data={"places": "bluetooth"}) as answer:
            assert answer.status == 403
        async with client.get(server.url) as answer:
            assert "Where to search" in await answer.text()


@pytest.mark.parametrize("is_file", [True, False], ids=["file", "given"])
async def test_the_token_of_a_file_or_of_the_program_is_required(tmp_path: Path, is_file: bool) -> None:
    token = tmp_path / "token"
    token.write_text(TOKEN)
    page, given = (loopback(token_file=token), None) if is_file else (loopback(), TOKEN)
    async with SetupServer(page, tmp_path / "pack.toml", given) as server, ClientSession() as client:
        async with client.get(server.url) as answer:
            assert answer.status == 401
        async with client.get(server.url, headers={"Authorization": f"Bearer {TOKEN}"}) as answer:
            assert "Where to search" in await answer.text()


@pytest.mark.parametrize(("user", "has_token"), [(0, True), (1000, False)])
def test_only_root_gets_a_page_with_a_token(
    capsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, user: int, has_token: bool
) -> None:
    ended = asyncio.Event()
    ended.set()
    monkeypatch.setattr("bms_estimator.cli.settings.setup.stop_on_signal", lambda: ended)
    monkeypatch.setattr("os.geteuid", lambda: user)
    code, out, err = run(capsys, "setup", tmp_path / "pack.toml", "--port", 0)
    assert code == 0, err
    assert bool(re.fullmatch(r"setup page: http://127\.0\.0\.1:\d+/\?token=[0-9a-f]{32}\n", out)) == has_token


def test_a_page_for_other_machines_without_a_token_is_refused(capsys, tmp_path: Path) -> None:
    err = error(run(capsys, "setup", tmp_path / "pack.toml", "--listen", "0.0.0.0:0"))
    assert "is open to other machines: name a token_file" in err
