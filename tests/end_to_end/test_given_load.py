"""Forecast under a load that a user gives, by MQTT and on the page, from a running service."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import pytest_asyncio
from playwright.async_api import Browser

from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.page.chromium import Tab, chromium, tab
from tests.page.house import Service, simulated

pytestmark = pytest.mark.asyncio(loop_scope="module")
module_fixture = pytest_asyncio.fixture(loop_scope="module", scope="module")

REQUEST, RESPONSE = "bms/attic/request/forecast", "bms/attic/response/forecast"
PROFILE = [[0, 300], [600, 900], [630, 300], [1800, 0]]
"""Points of time [s] and power [W]."""


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    with Broker(tmp_path_factory.mktemp("broker")) as running:
        yield running


@module_fixture
async def service(tmp_path_factory: pytest.TempPathFactory, broker: Broker) -> AsyncIterator[Service]:
    async with Service(tmp_path_factory.mktemp("service"), broker, free_port(), simulated()) as running:
        yield running


@module_fixture
async def client(broker: Broker, service: Service) -> AsyncIterator[Listener]:
    """Connect a client, and wait for the first state of the pack."""
    async with Listener(broker) as listener:
        await listener.wait("bms/attic/state")
        yield listener


@module_fixture
async def browser() -> AsyncIterator[Browser]:
    async with chromium() as running:
        yield running


async def ask(client: Listener, transaction: str, **arguments: Any) -> Any:
    """Send a request, and return its response."""
    await client.publish(REQUEST, json.dumps({**arguments, "transaction": transaction}))
    return await client.wait_json(RESPONSE, lambda response: response["transaction"] == transaction)


async def test_profile_is_answered_over_mqtt(client: Listener) -> None:
    response = await ask(client, "trip", profile=PROFILE)
    assert (response["status"], response["error"]) == ("ok", None)
    data = response["data"]
    assert data["time_to_cutoff_p05_s"] < data["time_to_cutoff_s"] < data["time_to_cutoff_p95_s"]
    assert (data["trip"]["duration_s"], data["trip"]["verdict"]) == (1800.0, "enough")
    assert data["trip"]["energy_wh"] == pytest.approx((300.0 * 1770.0 + 900.0 * 30.0) / 3600.0)


async def test_load_that_is_too_large_for_the_pack_is_not_enough(client: Listener) -> None:
    data = (await ask(client, "large", power_w=20_000, duration_s=60))["data"]
    assert data["trip"]["verdict"] == "not enough"


async def test_without_a_load_the_reason_says_what_is_missing(client: Listener) -> None:
    data = (await ask(client, "seen"))["data"]
    assert data["time_to_cutoff_s"] is None
    assert "less than 300 s of load" in data["reason"]


async def test_invalid_load_is_answered_with_the_error(client: Listener) -> None:
    response = await ask(client, "invalid", power_w="much")
    assert (response["status"], response["data"]) == ("error", None)
    assert "power_w = 'much': must be a number" in response["error"]


async def test_message_above_the_limit_of_mqtt_is_not_answered_and_the_service_goes_on(client: Listener) -> None:
    points = [[second, 300 + second % 2] for second in range(3000)]
    await client.publish(REQUEST, json.dumps({"profile": points, "transaction": "long"}))
    assert (await ask(client, "after"))["status"] == "ok"
    assert b'"long"' not in b"".join(client.all(RESPONSE))


async def answer_of(page_tab: Tab) -> str:
    """Submit the form, and return the answer."""
    await page_tab.page.get_by_role("button", name="Forecast").click()
    await page_tab.until("() => !document.querySelector('#whatif button').disabled")
    return await page_tab.page.inner_text("#whatif_answer")


async def test_page_answers_for_a_power_with_a_duration(browser: Browser, service: Service, client: Listener) -> None:
    async with tab(browser, service.url) as page_tab:
        await page_tab.page.get_by_label("Value").fill("300")
        await page_tab.page.get_by_role("spinbutton", name="for min").fill("30")
        answer = await answer_of(page_tab)
        assert "Charge for this load: enough, probability 100 %" in answer
        assert "90 % band" in answer
        assert "Energy needed: 150.0 Wh" in answer
        await page_tab.page.get_by_role("spinbutton", name="for min").fill("6000")
        assert "Charge for this load: not enough, probability 0 %" in await answer_of(page_tab)
        assert page_tab.errors == []


async def test_page_answers_for_a_file_of_current(
    browser: Browser, service: Service, client: Listener, tmp_path: Path
) -> None:
    file = tmp_path / "trip.csv"
    file.write_text("time_s;current_a\n0;5,5\n600;20\n630;5,5\n1800;0\n")
    async with tab(browser, service.url) as page_tab:
        await page_tab.page.get_by_label("Load").select_option("CSV file")
        await page_tab.page.set_input_files("#whatif_file", file)
        assert "Charge for this load: enough" in await answer_of(page_tab)
        file.write_text("time_s,current_a\n0,5\n600,x\n")
        await page_tab.page.set_input_files("#whatif_file", file)
        assert "Row 2: “x” is not a number." in await answer_of(page_tab)
        file.write_text("time_s,current_a\n0,5\n0,6\n5,6\n")
        await page_tab.page.set_input_files("#whatif_file", file)
        assert "point 2: time_s = 0 after 0: must increase" in await answer_of(page_tab)


async def test_server_rejects_forms_of_other_pages_unknown_packs_and_too_many_requests(
    service: Service, client: Listener
) -> None:
    payload = {"power_w": 300}
    async with aiohttp.ClientSession(service.url) as session:
        async with session.post("/forecast?pack=attic", data=payload) as response:
            assert response.status == 415
        async with session.post("/forecast?pack=cellar", json=payload) as response:
            assert (response.status, "where the service of the pack runs" in await response.text()) == (404, True)
        async with session.post("/forecast?pack=attic", json={"profile": [[0, 0]] * 20_000}) as response:
            assert response.status == 413
        statuses = [await post(session, payload) for _ in range(40)]
        assert 429 in statuses
        assert statuses[0] == 200


async def post(session: aiohttp.ClientSession, payload: dict[str, Any]) -> int:
    async with asyncio.timeout(60.0), session.post("/forecast?pack=attic", json=payload) as response:
        return response.status
