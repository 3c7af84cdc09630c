"""The page in a real Chromium: it shows the publications, and reports when they are not current.

The tests use Mosquitto, the service of the pack ``attic`` with its own page, and the ``dashboard`` of the broker, which is
the second page. The pack ``cellar`` is published by the tests themselves, so that they can publish any value.
"""

import contextlib
import json
import math
import re
from collections.abc import AsyncIterator, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import pytest_asyncio
from playwright.async_api import Browser

from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.mqtt.topic_cache import MAX_DEVICES
from bms_estimator.page.broker_page import dashboard
from bms_estimator.settings.connections import MqttSettings, PageSettings
from bms_estimator.sinks.home_assistant.discovery import BATTERY
from bms_estimator.telemetry.state import forecast_fields, no_forecast
from tests.free_port import free_port
from tests.mosquitto import Broker, Listener
from tests.page.chromium import PHONE, Tab, chromium, tab
from tests.page.house import Service, start_program
from tests.sinks.snapshots import CELL_SNAPSHOT, CELLS_REPORT, FORECAST, STACK_SNAPSHOT, forecast_at
from tests.store.test_history import record_history, snapshot_at

pytestmark = pytest.mark.asyncio(loop_scope="module")
module_fixture = pytest_asyncio.fixture(loop_scope="module", scope="module")

MINUS, DASH = "\N{MINUS SIGN}", "\N{EN DASH}"
PACK_SECTION = 'cell = "lfp"\ncapacity_ah = 100\nseries = 4\ninitial_soc = 0.6'
CELLS_V = (3.311, 3.325, 3.318, 3.322)
STATE_VALUES = {  # as published in ``state``
    "soc": 0.4321,
    "soc_percent": 43.21,
    "soc_std": 0.0123,
    "soc_known": True,
    "voltage_v": 52.3456,
    "voltage_estimate_v": 52.4,
    "current_a": -12.3456,
    "power_w": -646.2,
    "temperature_c": 21.37,
    "innovation_v": -0.0543,
    "remaining_energy_wh": 2345.6,
    "usable_capacity_ah": 45.678,
    "time_to_cutoff_s": None,
    "time_to_full_s": 11_520.0,
    "energy_out_kwh": 12.3456,
    "energy_in_kwh": 123.456,
    "delta_1": 0.031,
    "delta_2": 0.0789,
    "weakest_cell_soc": 0.3871,
    "weakest_cell_soc_std": 0.0184,
    "device_soc": 0.41,
    "stability_margin": 0.3532,
    "nussbaum_gain": 0.97,
    "stability_margin_std": 0.021,
    "cells_v": [3.271, 3.2755, None, 3.2688],
}
SHOWN_TEXTS = {  # by quantity (attribute ``data-q``)
    "soc": "43.2",
    "soc_std": "2.5",  # two std in percent
    "voltage_v": "52.35 V",
    "current_a": f"{MINUS}12.35 A",
    "way": "charging",
    "power_w": f"{MINUS}646 W",
    "temperature_c": "21.4 °C",
    "remaining_energy_wh": "2346 Wh",
    "usable_capacity_ah": "45.68 Ah",
    "time_left": "3 h 12 min",
    "time_left_label": "To full",
    "energy_out_kwh": "12.35 kWh",
    "energy_in_kwh": "123.5 kWh",
    "device_soc": "41",
    "weakest_cell_soc": "38.7",
    "weakest_cell_soc_std": "3.7",  # two std in percent
    "celllow": "3.269 V · cell 4",
    "cellhigh": "3.276 V · cell 2",
    "cellapart": "6.7 mV",
    "cellspread": "3 measured",
}


class RunningPrograms(NamedTuple):
    """Running broker, service and dashboard, and a client of the broker.

    Attributes:
        broker: The broker.
        service: Service of the pack ``attic``.
        dashboard: URL of the dashboard.
        live: Client that publishes the topics of the pack ``cellar``.
    """

    broker: Broker
    service: Service
    dashboard: str
    live: Listener


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page")


@pytest.fixture(scope="module")
def broker(folder: Path) -> Iterator[Broker]:
    with Broker(folder) as running:
        yield running


@module_fixture
async def browser() -> AsyncIterator[Browser]:
    async with chromium() as running:
        yield running


def board(_time_s: float) -> dict[str, Any]:
    """Return the constant values that the board prints."""
    return {"voltage": sum(CELLS_V), "current": 2.5, "temperature": 21.5, "cells": CELLS_V}


@module_fixture
async def programs(folder: Path, broker: Broker) -> AsyncIterator[RunningPrograms]:
    await record_history(folder / "cellar.sqlite", [])
    port = free_port()
    async with (
        Service(folder, broker, free_port(), board, pack=PACK_SECTION, rate_hz=2.0) as service,
        Listener(broker) as live,
    ):
        arguments = ("--mqtt", broker.url, "--listen", f"127.0.0.1:{port}", "--folder", folder, "--no-browser")
        process = await start_program(folder, "dashboard", *arguments, port=port)
        await publish(live, "availability", b"online")
        await publish(live, "sensor/availability", b"online")
        await publish(live, "info", CELL_SNAPSHOT.info.model_copy(update={"device": "cellar"}).model_dump_json())
        await publish(live, "health", CELL_SNAPSHOT.health.model_dump_json())
        yield RunningPrograms(broker, service, f"http://127.0.0.1:{port}/", live)
        process.terminate()
        assert await process.wait() == 0


async def publish(live: Listener, topic: str, payload: str | bytes, *, retain: bool = True) -> None:
    """Publish a message of the pack ``cellar``."""
    await live.publish(f"bms/cellar/{topic}", payload, qos=1, retain=retain)


async def publish_state(live: Listener, **values: Any) -> dict[str, Any]:
    """Publish a state of the pack ``cellar`` with changed values. Return the state."""
    assert CELL_SNAPSHOT.estimate
    state = CELL_SNAPSHOT.estimate.model_dump() | {"time": "2026-11-22T16:04:05.000Z"} | values
    await publish(live, "state", json.dumps(state), retain=False)
    return state


@contextlib.asynccontextmanager
async def dashboard_of(browser: Browser, programs: RunningPrograms, pack: str, **options: Any) -> AsyncIterator[Tab]:
    """Open the dashboard at a pack."""
    async with tab(browser, f"{programs.dashboard}#{pack}", **options) as page_tab:
        await page_tab.until("name => document.getElementById('name').textContent === name", pack)
        yield page_tab


async def test_page_shows_the_published_values_with_units(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish_state(programs.live, **STATE_VALUES)
        await page_tab.until_text("soc", SHOWN_TEXTS["soc"])
        assert {name: await page_tab.text(name) for name in SHOWN_TEXTS} == SHOWN_TEXTS
        await page_tab.page.get_by_text("For experts").click()
        assert await page_tab.page.inner_text("#facts div:has-text('Observer, N(k)')") == "Observer, N(k)\n0.97"
        for key in ("remaining_energy_wh", "remaining_capacity_ah", "usable_capacity_ah"):
            assert await page_tab.page.locator(f"[data-of={key}]", has_text=BATTERY[key].name).count() == 1
        meter = page_tab.page.get_by_role("meter", name="State of charge")
        assert await meter.get_attribute("aria-valuenow") == "43"
        assert (
            await page_tab.page.evaluate(
                """async () => {
                (await import("./state.js")).drawState({}, { value: 0.967, std: 0.031, valid: false });
                return document.querySelector("[data-q=capacity_note]").textContent;
            }"""
            )
            == "so far 97 ± 6 %"
        )
        assert await page_tab.page.get_by_role("img", name="cell 4: 3.269 V, lowest").is_visible()
        assert await page_tab.page.get_by_role("img", name="cell 3: not measured").count() == 1
        assert await page_tab.page.title() == "43 % · cellar"
        await page_tab.until_status("live")
        assert page_tab.errors == []


async def test_the_forecast_is_shown_as_curves_and_with_its_band(browser: Browser, programs: RunningPrograms) -> None:
    assert CELL_SNAPSHOT.forecast
    shown = {
        "time_left_label": "To cut-off",
        "time_left": "1 h 50 min",
        "time_left_band": f"90 % band 1 h 23 min {DASH} 2 h 45 min",
    }
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        power = {"available_discharge_power_10s_w": 450.4, "available_discharge_power_60s_w": 420.0}
        await publish_state(programs.live, **forecast_fields(FORECAST, FORECAST.time_s) | power)
        await publish(programs.live, "forecast", CELL_SNAPSHOT.forecast.json_bytes, retain=False)
        await page_tab.until_text("time_left", shown["time_left"])
        assert {name: await page_tab.text(name) for name in shown} == shown
        await page_tab.until_text("cutoff_within", "0 %, 0 %, 1 %")
        assert await page_tab.text("discharge_power") == "450 W, 420 W"
        assert await page_tab.text("discharge_limit") == "current limit assumed"
        await publish_state(programs.live, available_discharge_power_10s_w=450.4, available_discharge_power_60s_w=None)
        await page_tab.until_text("discharge_power", f"450 W, {DASH}")
        for chart in ("Voltage, forecast: from 2.700 to 3.800 V", "State of charge, forecast: from 0.000 to 50.000 %"):
            await page_tab.page.get_by_role("img", name=chart).wait_for()
        await page_tab.page.get_by_role("img", name="Load still on, probability, forecast: from 0").wait_for()
        assert ":" not in await page_tab.page.evaluate(  # two midnights within 36 h
            """async () => (await import("./forecast.js")).charts.v.plot.axes[0]
            .values({ scales: { x: { min: 0, max: 130000 } } }, [0, 86400]).join()"""
        )
        assert page_tab.errors == []


async def test_a_change_that_lowers_the_bound_of_the_std_by_a_fifth_is_named(
    browser: Browser, programs: RunningPrograms
) -> None:
    health = CELL_SNAPSHOT.health.model_dump()
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish_state(programs.live, **STATE_VALUES)
        for changed_std, ends in ((0.015, "to ± 3 %, instead of ± 8 % at best in the present use."), (0.035, "")):
            bound = {"std": 0.04, "change": "a full charge each week", "changed_std": changed_std}
            await publish(programs.live, "health", json.dumps(health | {"pack_model": {"soc_bound": bound}}))
            await page_tab.until(
                """ends => {
                const line = document.getElementById("whathelps");
                return line.checkVisibility() === !!ends && line.innerText.endsWith(ends);
            }""",
                ends,
            )
        await publish(programs.live, "health", json.dumps(health | {"suspects": ["pack.series = 8: 52.80 V"]}))
        await page_tab.page.get_by_text("pack.series = 8: 52.80 V").wait_for()
        await publish(programs.live, "health", json.dumps(health))
        assert page_tab.errors == []


async def test_below_ten_minutes_the_page_shows_the_band_and_no_single_time(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        fields = forecast_fields(forecast_at(480.0), 0.1) | {"cutoff_within_5min": 0.34}
        await publish_state(programs.live, **fields)
        await page_tab.until_text("time_left", f"6{DASH}12 min")
        assert await page_tab.text("time_left_band") == "90 % band; 34 % within 5 min"
        assert "8 min" not in await page_tab.page.inner_text(".hero")


async def test_the_reason_for_a_missing_forecast_is_shown(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish_state(programs.live, **forecast_fields(no_forecast("the pack is charged"), 0.0))
        await page_tab.page.get_by_text("No time to the cut-off: the pack is charged.").wait_for()
        assert not await page_tab.page.locator("#forecast").is_visible()
        assert await page_tab.text("time_left") == ""


async def test_unknown_values_are_hidden(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        state = await publish_state(
            programs.live, soc_std=None, temperature_c=None, innovation_v=None, voltage_v=3.21, time_to_cutoff_s=None
        )
        await page_tab.until_text("voltage_v", "3.210 V")
        for name in ("soc_std", "temperature_c", "innovation_v", "time_left", "celllow"):
            assert await page_tab.text(name) == "", name
        assert STACK_SNAPSHOT.estimate
        await publish_state(programs.live, **STACK_SNAPSHOT.estimate.model_dump(exclude={"time"}))
        await page_tab.until_text("voltage_v", "13.00 V")
        assert not await page_tab.page.locator(".hero").is_visible()  # a fuel cell has no state of charge
        for key in set(state) - {"time", "voltage_v"}:
            state.pop(key)
        await publish_state(programs.live, **dict.fromkeys(STATE_VALUES))
        await page_tab.until_text("voltage_v", "")
        body = await page_tab.page.inner_text("body")
        assert not re.search("NaN|undefined|null|Infinity", body)
        assert page_tab.errors == []


async def test_values_of_the_model_are_one_tap_away_from_the_page_of_the_owner(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish_state(programs.live, **STATE_VALUES | {"delta_1": -0.0205, "delta_2": 0.0789})
        await page_tab.until_text("soc", SHOWN_TEXTS["soc"])
        model = {"innovation_v", "stability_margin", "invalid_below", "voltage_estimate_v"}
        assert {await page_tab.text(name) for name in model} == {""}
        await page_tab.page.get_by_text("For experts").click()
        await page_tab.until_text("invalid_below", "7.9")
        assert "" not in {await page_tab.text(name) for name in model}
        assert page_tab.errors == []


async def test_lock_and_e_of_the_observer_are_shown_under_its_name_and_not_on_the_tiles(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        page = page_tab.page
        observer = {"lock": True, "converged": False, "tracking_error_v": -0.0027, "nussbaum_gain": 0.8}
        await publish_state(programs.live, **STATE_VALUES | observer | {"soc_std": None})  # without the identifier
        await page.get_by_text("For experts").click()
        await page_tab.until_text("innovation_of", "of the observer")
        await publish_state(programs.live, **STATE_VALUES | observer)
        row = page.locator("#facts div").filter(has=page.get_by_text("Observer", exact=True))
        await row.get_by_text(f"in lock, converging, e {MINUS}2.7 mV").wait_for()
        assert "lock" not in await page.inner_text(".hero") + await page.inner_text(".tiles")
        assert page_tab.errors == []


async def test_an_soc_that_is_not_known_is_not_shown_as_a_number(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        page, parts = page_tab.page, ("#soc", "#scale", "[data-of=soc_std]")
        for known in (True, False, True):
            await publish_state(programs.live, **STATE_VALUES | {"soc_known": known})
            await page.locator("#soc").wait_for(state="visible" if known else "hidden")
            assert await page.locator("#unknownsoc").is_visible() is not known
            assert [await page.locator(part).is_visible() for part in parts] == [known] * len(parts)
            assert await page.title() == ("43 % · cellar" if known else "cellar")
        assert page_tab.errors == []


async def test_the_weakest_and_faulty_cells_are_named(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish_state(programs.live, **STATE_VALUES)
        await publish(programs.live, "cells", CELLS_REPORT.model_dump_json(), retain=False)
        name = page_tab.page.locator("[data-q=weakestcell]")
        await name.get_by_text("cell 2; cell 2: internal short; cell 3: contact", exact=True).wait_for()
        bar = page_tab.page.get_by_role("img", name="cell 2: 3.276 V, weakest")  # cell 4 has the lowest voltage
        assert await bar.is_visible()
        assert await page_tab.page.locator("#cells .weakest").count() == 1
        assert page_tab.errors == []


async def test_page_of_the_service_and_dashboard_show_equal_values_and_load_nothing_from_elsewhere(
    browser: Browser, programs: RunningPrograms
) -> None:
    parameters = await programs.live.wait_json("bms/attic/parameters")
    await programs.live.publish("bms/attic/request/set_soc", b'{"soc": 0.66}')
    await programs.live.wait_json("bms/attic/response/set_soc", lambda response: response["status"] == "ok")
    await programs.live.wait_json("bms/attic/state", lambda s: s["soc_known"])  # the pages show no unknown SOC
    async with tab(browser, programs.service.url) as own, dashboard_of(browser, programs, "attic") as other:
        for page_tab in (own, other):
            await page_tab.until_text("voltage_v", f"{sum(CELLS_V):.2f} V")
            assert await page_tab.text("current_a") == "2.500 A"
            assert await page_tab.text("power_w") == f"{2.5 * sum(CELLS_V):.1f} W"
            assert await page_tab.text("temperature_c") == "21.5 °C"
            assert await page_tab.text("way") == "discharging"
            for name, published, factor in (("soc", "soc", 100.0), ("soc_std", "soc_std", 200.0)):
                text = await page_tab.text(name)
                await programs.live.wait_json("bms/attic/state", lambda s: f"{factor * s[published]:.1f}" == text)  # noqa: B023
            assert await page_tab.text("celllow") == "3.311 V · cell 1"
            assert re.search(r"in series · nominal [\d.]+ V · ", await page_tab.page.inner_text("#what"))
            await page_tab.until(
                "count => document.querySelectorAll('#params tr').length === count",
                sum(len(parameters[group]) for group in ("a", "elements", "state_of_health")),
            )
            assert await page_tab.text("capacity_health") == "not known yet"
            await page_tab.page.get_by_text("For experts").click()
            row = page_tab.page.locator('[data-p="a a1"]')
            text = (await row.locator("td").nth(0).inner_text()).replace(MINUS, "-")
            await programs.live.wait_json("bms/attic/parameters", lambda p: format_parameter(p["a"]["a1"]) == text)  # noqa: B023
            await page_tab.until_status("live")
            assert page_tab.errors == []
            origin = "/".join(page_tab.page.url.split("/")[:3])
            assert all(url.startswith(origin) for url in page_tab.requests), page_tab.requests
        assert await own.page.locator("#events li").count() >= 2, "start and sensor_online came before the visitor"
        assert await own.page.get_by_role("tab").count() == 0
        assert await other.page.get_by_role("tab").count() == 2


def format_parameter(parameter: dict[str, Any]) -> str:
    """Format a value to the two digits of its standard deviation, or to four without one."""
    if parameter["std"] is None:
        return f"{parameter['value']:.4g}"
    decimals = 1 - math.floor(math.log10(parameter["std"]))
    return f"{parameter['value']:.{decimals}f}"


async def test_packs_spans_and_elements_are_selected_by_keyboard(browser: Browser, programs: RunningPrograms) -> None:
    async with dashboard_of(browser, programs, "attic") as page_tab:
        page = page_tab.page
        await page.keyboard.press("Tab")
        assert await page.evaluate("document.activeElement.textContent") == "attic"
        await page.keyboard.press("ArrowRight")
        await page_tab.until("() => document.getElementById('name').textContent === 'cellar'")
        selected = page.get_by_role("tab", selected=True)
        assert await selected.inner_text() == "cellar"
        assert page.url.endswith("#cellar")
        await page.keyboard.press("Home")
        await page_tab.until("() => document.getElementById('name').textContent === 'attic'")
        await page.keyboard.press("Tab")
        await page.keyboard.press("ArrowRight")
        assert await page.get_by_role("radio", name="Hour").is_checked()
        await page.keyboard.press("ArrowLeft")
        await page.keyboard.press("Tab")
        assert await page.evaluate("document.activeElement.textContent") == "For experts"
        await page.keyboard.press("Enter")
        await page.keyboard.press("Tab")
        assert await page.evaluate("document.activeElement.id") == "element"


async def test_an_alarm_is_shown_while_it_is_raised(browser: Browser, programs: RunningPrograms) -> None:
    alarm = Alarm(
        name="cell_under_voltage",
        severity="critical",
        active=True,
        latched=True,
        since="2026-11-22T16:00:00.000Z",
        value=2.412,
        limit=2.5,
        unit="V",
        text="cell 3 has 2.412 V, limit 2.5 V: stop discharging",
        unknown_reason="the SOC is not known yet",
    )
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        await publish(programs.live, "alarm/cell_under_voltage", alarm.model_dump_json())
        element = page_tab.page.get_by_role("alert").locator(".alarm")
        await element.wait_for()
        text = await element.inner_text()
        for part in (
            "the SOC is not known yet",
            "under voltage",
            "cell 3 has 2.412 V, limit 2.5 V: stop discharging",
            "critical",
            "latched",
        ):
            assert part in text
        assert text.count("2.412") == 1
        cleared = alarm.model_copy(update={"active": False, "latched": False, "since": None, "value": None, "text": ""})
        await publish(programs.live, "alarm/cell_under_voltage", cleared.model_dump_json())
        await element.wait_for(state="detached")
        unwatched = cleared.model_copy(update={"watched": False, "unwatched_reason": "cell voltages are missing"})
        await publish(programs.live, "alarm/cell_under_voltage", unwatched.model_dump_json())
        await element.wait_for()
        text = await element.inner_text()
        assert "cell voltages are missing" in text
        assert "cannot be watched" in text
        await publish(
            programs.live,
            "alarm/cell_over_voltage",
            unwatched.model_copy(update={"name": "cell_over_voltage"}).model_dump_json(),
        )
        rows = page_tab.page.locator(".alarm")
        await rows.get_by_text("cell under voltage, cell over voltage").wait_for()
        assert await rows.count() == 1
        await publish(
            programs.live,
            "alarm/sensor_fault",
            alarm.model_copy(
                update={"name": "sensor_fault", "text": "cell voltages are missing: ..."}
            ).model_dump_json(),
        )
        await rows.get_by_text("sensor fault").wait_for()
        assert await rows.count() == 1
        for name in ("cell_under_voltage", "cell_over_voltage", "sensor_fault"):
            await publish(programs.live, f"alarm/{name}", b"")
        assert page_tab.errors == []


async def test_live_curves_are_interrupted_where_samples_are_missing(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        for second in (0, 1, 2, 30, 31):
            await publish_state(programs.live, voltage_v=40.0 + second, time=f"2026-11-23T16:04:{second:02}.000Z")
        drawn = """async () => {
            const [time, , , voltage] = (await import("./curves.js")).curves.v?.plot.data ?? [[], [], [], []];
            return JSON.stringify(voltage.slice(time.indexOf(Date.parse("2026-11-23T16:04:00Z") / 1e3))) === "[40,41,42,null,70,71]";
        }"""
        await page_tab.until(drawn)
        assert page_tab.errors == []


async def test_a_state_dated_far_in_the_future_does_not_stop_the_live_curves(
    browser: Browser, programs: RunningPrograms
) -> None:
    assert CELL_SNAPSHOT.estimate
    states = (
        (50.0, "2026-11-22T17:00:00.000Z"),
        (99.0, "9999-01-01T00:00:00.000Z"),
        (52.0, "2026-11-22T17:00:05.000Z"),
    )

    async def publish_at(voltage_v: float, time: str) -> None:
        state = CELL_SNAPSHOT.estimate.model_dump() | {"voltage_v": voltage_v, "time": time}
        await programs.live.publish("bms/shed/state", json.dumps(state), qos=1)

    await publish_at(*states[0])
    async with dashboard_of(browser, programs, "shed") as page_tab:
        for voltage_v, time in states:
            await publish_at(voltage_v, time)
            await page_tab.until_text("voltage_v", f"{voltage_v:.2f} V")
        await page_tab.until(
            "() => [...document.querySelectorAll('.curve [role=img]')].some((e) => e.ariaLabel?.endsWith('last 52.000 V'))"
        )
        await programs.live.publish("bms/shed/state", b"", qos=1)
        await page_tab.until(
            "() => ![...document.querySelectorAll('#packs button')].some((t) => t.textContent === 'shed')"
        )
        assert page_tab.errors == []


async def test_pack_with_an_alarm_is_listed_first_among_too_many_packs(
    browser: Browser, broker: Broker, folder: Path
) -> None:
    """The test has a dashboard of its own, because its packs would remain on the other one, which shows at most 64."""
    settings = MqttSettings(url=broker.url, base_topic="crowd")
    alarm = Alarm(
        name="over_temperature",
        severity="critical",
        active=True,
        latched=False,
        since=None,
        value=70.0,
        limit=60.0,
        unit="°C",
        text="70 °C",
    )
    async with (
        Listener(broker) as live,
        dashboard(settings, PageSettings(listen="127.0.0.1:0"), folder) as url,
        tab(browser, url) as page_tab,
    ):
        for number in range(100):
            await live.publish(f"crowd/a{number:03}/availability", b"online", qos=1, retain=True)
        await page_tab.until("() => document.getElementById('hidden').textContent === '36 more devices not shown'")
        await live.publish("crowd/zz/alarm/over_temperature", alarm.model_dump_json(), qos=1, retain=True)
        await page_tab.until("() => document.querySelector('#packs button')?.textContent === 'zz'")
        await page_tab.until("() => document.getElementById('hidden').textContent === '37 more devices not shown'")
        assert await page_tab.page.get_by_role("tab").count() == MAX_DEVICES
        first = page_tab.page.get_by_role("tab").first
        await first.click()
        await page_tab.until("() => document.getElementById('alarms').textContent.includes('70 °C')")
        assert "raised" in str(await first.get_attribute("class"))
        await live.publish("crowd/zz/alarm/over_temperature", b"", qos=1, retain=True)
        await page_tab.until(
            "() => ![...document.querySelectorAll('#packs button')].some((t) => t.textContent === 'zz')"
        )
        assert page_tab.errors == []


async def test_history_is_drawn_for_each_span(browser: Browser, programs: RunningPrograms, folder: Path) -> None:
    """The history has one publication each 30 s, until now."""
    now_s = datetime.now(UTC).timestamp()
    begin_s = datetime.fromisoformat(snapshot_at(0.0).estimate.time).timestamp()
    await record_history(
        folder / "cellar.sqlite", [snapshot_at(now_s - begin_s - 30.0 * s, 3.0, 3.9) for s in range(100, 0, -1)]
    )
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        for span in ("Hour", "Day", "Month"):
            await page_tab.page.get_by_text(span, exact=True).click()
            chart = page_tab.page.get_by_role("img", name=f"Voltage, last {span.lower()}: from 3.900 to 3.900 V")
            await chart.wait_for()
            assert await chart.locator("canvas").is_visible()
        assert page_tab.errors == []


async def test_missing_history_is_reported(browser: Browser, programs: RunningPrograms) -> None:
    await programs.live.publish("bms/guest/availability", b"online", qos=1)
    async with dashboard_of(browser, programs, "guest") as page_tab:
        await page_tab.page.get_by_text("Day", exact=True).click()
        await page_tab.page.get_by_text("No history is kept here").wait_for()


async def test_page_is_stale_while_the_sensor_or_the_service_is_offline(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "cellar") as page_tab:
        state = await publish_state(programs.live)
        await page_tab.until_status("live")
        offline = CELL_SNAPSHOT.health.model_copy(
            update={"sensor_online": False, "sensor_message": "the board is silent"}
        )
        await publish(programs.live, "health", offline.model_dump_json())
        await publish(programs.live, "sensor/availability", b"offline")
        await page_tab.until_status(f"stale since {datetime.fromisoformat(state['time']).astimezone():%H:%M:%S}")
        assert "the board is silent" in await page_tab.page.inner_text("#why")
        await publish(programs.live, "sensor/availability", b"online")
        await publish(programs.live, "health", CELL_SNAPSHOT.health.model_dump_json())
        await page_tab.until_status("live")
        await publish(programs.live, "availability", b"offline")
        await page_tab.until_status("stale since")
        assert await page_tab.page.inner_text("#why") == "the service is offline"
        await publish(programs.live, "availability", b"online")
        await page_tab.until_status("live")


@pytest.mark.thorough
async def test_page_is_stale_after_a_kill_of_the_service_and_live_after_its_restart(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with (
        tab(browser, programs.service.url) as own,
        dashboard_of(browser, programs, "attic") as other,
    ):
        await own.until_status("live")
        await other.until_status("live")
        await programs.service.kill()
        await own.until_status("stale since")
        assert await own.page.inner_text("#why") == "the page's server does not answer"
        await other.until_status("stale since")
        assert await other.page.inner_text("#why") == "the service is offline"
        await programs.service.start()
        await own.until_status("live")
        await other.until_status("live")


async def test_page_is_stale_from_the_loss_of_the_broker_until_new_values_arrive(
    browser: Browser, programs: RunningPrograms
) -> None:
    async with dashboard_of(browser, programs, "attic") as page_tab:
        await page_tab.until_status("live")
        programs.broker.stop()
        await page_tab.until_status("stale since")
        assert await page_tab.page.inner_text("#why")
        programs.broker.start()
        await page_tab.until_status("live")


async def test_page_for_other_machines_requires_the_token(browser: Browser, folder: Path, broker: Broker) -> None:
    token = folder / "token"
    token.write_text("0123456789abcdef")
    settings = PageSettings(listen=f"0.0.0.0:{free_port()}", token_file=token)
    async with dashboard(MqttSettings(url=broker.url), settings, folder) as url, tab(browser, url) as page_tab:
        assert await page_tab.page.locator("#pack").count() == 0
        await page_tab.page.get_by_label("Token").fill("0123456789abcdef")
        await page_tab.page.keyboard.press("Enter")
        await page_tab.page.locator("#pack").wait_for()
        assert "token" not in page_tab.page.url
        await page_tab.page.reload()
        await page_tab.page.locator("#pack").wait_for()


@pytest.mark.parametrize("size", [PHONE, {"width": 320, "height": 600}, {"width": 1920, "height": 1080}], ids=str)
async def test_no_element_is_wider_than_the_screen(
    browser: Browser, programs: RunningPrograms, size: dict[str, int]
) -> None:
    async with dashboard_of(browser, programs, "attic", size=size) as page_tab:
        await page_tab.until_text("celllow", "3.311 V · cell 1")
        find_wider = """width => [...document.querySelectorAll("body, header *, #pack, .card, .card :not(.scroll *)")]
            .filter((e) => e.getBoundingClientRect().right > width + 0.5).map((e) => e.outerHTML.slice(0, 80))"""
        assert await page_tab.page.evaluate(find_wider, size["width"]) == []
