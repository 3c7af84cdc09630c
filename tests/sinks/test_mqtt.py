import asyncio
import json
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest

from bms_estimator.estimator import Estimator
from bms_estimator.kernels.state import TRACE
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.estimate import Estimate, Snapshot
from bms_estimator.model.sample import SAMPLE
from bms_estimator.model.settings import MqttSettings, Settings
from bms_estimator.sinks.home_assistant import discovery
from bms_estimator.sinks.mqtt import MqttSink
from bms_estimator.snapshot.health import health_report
from bms_estimator.snapshot.parameters import parameter_report
from bms_estimator.snapshot.remaining import remaining_charge
from bms_estimator.snapshot.topics import estimate_report, info_report
from bms_estimator.snapshot.window import Window
from tests.mosquitto import MOSQUITTO, Broker, Listener

NOW = 1_700_000_000.0
RETAINED = ("info", "availability", "sensor/availability", "schema", "health")


def snapshot(sensor_message: str | None = None) -> Snapshot:
    cell = load_cell("chen_mora")
    estimator = Estimator(cell, identifier=None, initial_soc=0.5)
    window = Window()
    block = np.zeros(2, dtype=SAMPLE)
    block["time_s"], block["voltage_v"], block["temperature_c"] = [0.0, 0.1], 3.8, np.nan
    trace = estimator.run(block)
    assert trace.dtype == TRACE
    window.add(trace, NOW)
    summary = window.take()
    assert summary
    return Snapshot(
        estimate_report(summary, remaining_charge(estimator, 0.0), {"crc_errors": 3}, NOW),
        parameter_report(estimator, NOW),
        health_report(
            estimator.record[0],
            {"frames_received": 2},
            now_s=NOW,
            uptime_s=1.0,
            restarts=0,
            checkpoint="off",
            sensor_message=sensor_message,
        ),
        info_report(Settings(), cell, {"firmware": "1.0", "serial_number": "A1"}, NOW),
    )


ONE = snapshot()


async def refuse(name: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    raise UserError(f"{name}: not here")


def sink(broker: Broker, **options: Any) -> MqttSink:
    options = {"first_delay_s": 0.1, "birth_delay_s": 0.1, "answer": refuse} | options
    return MqttSink(MqttSettings(url=broker.url), "pack", **options)


async def test_topics_and_retained_flags_are_as_documented(broker: Broker) -> None:
    async with Listener(broker) as live, sink(broker) as mqtt:
        mqtt.publish(snapshot())
        await live.wait("homeassistant/device/bms_pack/config")
        async with Listener(broker) as late:
            for topic in RETAINED:
                await late.wait(f"bms/pack/{topic}")
            await late.wait("homeassistant/device/bms_pack/config")
            kept = {name for name, _, retain in late.messages if retain}
    assert kept == {f"bms/pack/{topic}" for topic in RETAINED} | {"homeassistant/device/bms_pack/config"}
    assert live.all("bms/pack/availability") == [b"online", b"offline"]
    assert live.all("bms/pack/sensor/availability") == [b"online", b"offline"]
    assert {"bms/pack/state", "bms/pack/parameters"} <= {name for name, _, _ in live.messages}


async def test_parameters_come_not_before_the_first_sample(broker: Broker) -> None:
    cell = load_cell("chen_mora")
    nothing_yet = ONE._replace(estimate=None, parameters=parameter_report(Estimator(cell, identifier=None), NOW))
    async with Listener(broker) as live, sink(broker) as mqtt:
        mqtt.publish(nothing_yet)
        await live.wait("homeassistant/device/bms_pack/config")
        assert live.all("bms/pack/parameters") == []
        mqtt.publish(ONE)
        assert (await live.wait_json("bms/pack/parameters"))["elements"]


async def test_state_has_the_fields_of_the_published_schema_and_null_for_what_is_missing(broker: Broker) -> None:
    async with Listener(broker) as live, sink(broker) as mqtt:
        mqtt.publish(snapshot())
        state = await live.wait_json("bms/pack/state")
        schema = await live.wait_json("bms/pack/schema")
    described = schema["state"]["properties"]
    assert set(state) == set(described) == set(schema["state"]["required"])
    assert all("description" in field for field in described.values())
    assert state["temperature_c"] is None
    assert state["soc_percent"] == pytest.approx(50.0)
    assert state["crc_errors"] == 3
    Estimate.model_validate(state)


async def test_discovery_describes_every_entity_with_both_availabilities(broker: Broker) -> None:
    async with Listener(broker) as live, sink(broker) as mqtt:
        mqtt.publish(snapshot())
        found = await live.wait_json("homeassistant/device/bms_pack/config")
        state = await live.wait_json("bms/pack/state")
    assert found["device"]["identifiers"] == ["bms_pack"]
    assert found["origin"]["name"] == "bms_estimator"
    assert found["availability_mode"] == "all"
    assert [a["topic"] for a in found["availability"]] == ["bms/pack/availability", "bms/pack/sensor/availability"]
    components = found["components"]
    soc, current = components["soc_percent"], components["current_a"]
    assert (soc["device_class"], soc["unit_of_measurement"], soc["expire_after"]) == ("battery", "%", 3)
    assert "discharge positive" in current["name"]
    assert "device_class" not in components["r_s_ohm"]
    assert components["lock_lost"]["device_class"] == "problem"
    unique = [component["unique_id"] for component in components.values()]
    assert len(set(unique)) == len(unique)
    for key, component in components.items():
        if component["state_topic"] == "bms/pack/state" and key != "lock_lost":
            assert key in state


@pytest.mark.parametrize(("rate_hz", "sample_period_s", "expire_s"), [(0.1, 1.0, 30), (10.0, 1.0, 3), (1.0, 2.5, 8)])
def test_a_value_expires_after_three_periods_of_publishing_or_of_sampling(
    rate_hz: float, sample_period_s: float, expire_s: int
) -> None:
    info = ONE.info.model_copy(update={"publish_rate_hz": rate_hz})
    components = discovery(info, "bms/pack", sample_period_s)["components"].values()
    assert {c["expire_after"] for c in components if "expire_after" in c} == {expire_s}


async def test_retained_messages_are_sent_again_when_home_assistant_is_born(broker: Broker) -> None:
    async with Listener(broker) as live, sink(broker) as mqtt:
        mqtt.publish(snapshot())
        await live.wait("homeassistant/device/bms_pack/config")
        before = len(live.messages)
        await live.publish("homeassistant/status", b"online")
        while len(live.all("homeassistant/device/bms_pack/config")) < 2:
            mqtt.publish(snapshot())
            await asyncio.sleep(0.05)
        for topic in ("info", "availability", "schema", "health"):
            await live.wait(f"bms/pack/{topic}", skip=before)


async def test_a_broker_that_comes_late_goes_and_comes_back_is_served_and_drops_are_counted(tmp_path: Path) -> None:
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    broker = Broker(tmp_path)
    async with sink(broker) as mqtt:
        for _ in range(5):
            mqtt.publish(snapshot())
        assert mqtt.drops == 4
        for _ in range(2):  # persistence is off: each start has forgotten everything
            broker.start()
            try:
                async with Listener(broker) as live:
                    mqtt.publish(snapshot())
                    for topic in (*RETAINED, "state"):
                        await live.wait(f"bms/pack/{topic}")
                    health = await live.wait_json("bms/pack/health")
                    assert health["publish_drops"] >= 4
            finally:
                await asyncio.to_thread(broker.stop)


async def test_publish_returns_at_once_and_the_sink_closes_without_a_broker(tmp_path: Path) -> None:
    broker = Broker(tmp_path)  # never started
    async with sink(broker) as mqtt:
        for _ in range(1000):
            mqtt.publish(ONE)
    assert mqtt.drops == 999


@pytest.mark.parametrize(
    ("payload", "status", "transaction"),
    [
        (b'{"transaction": "t1", "x": 2}', "ok", "t1"),
        (b"", "ok", None),
        (b'{"transaction": 7, "refuse": true}', "error", 7),
        (b"[1, 2]", "error", None),
        (b"\xff\xfe not json", "error", None),
        (b"[" * 5000, "error", None),
        (b'{"transaction": NaN}', "error", None),
        (b'{"transaction": [1e999], "x": 1}', "error", None),
        (b'{"transaction": "t2", "x": -Infinity}', "error", None),
        (b'{"transaction": 1.5}', "error", None),
        (b'{"transaction": true}', "error", None),
        (b'{"transaction": {"a": 1}}', "error", None),
    ],
)
async def test_a_request_is_answered(broker: Broker, payload: bytes, status: str, transaction: object) -> None:
    async def echo(name: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        if arguments.get("refuse"):
            raise UserError("refused")
        return {"name": name, "x": arguments.get("x")}

    async with Listener(broker) as live, sink(broker, answer=echo) as mqtt:
        mqtt.publish(ONE)
        await live.wait("bms/pack/availability")
        await live.publish("bms/pack/request/echo", payload, qos=1)
        response = await live.wait_json("bms/pack/response/echo")
    assert set(response) == {"status", "data", "error", "transaction"}
    assert (response["status"], response["transaction"]) == (status, transaction)
    assert (response["data"] is None) == (status == "error")
    assert (response["error"] is None) == (status == "ok")


async def test_a_fault_of_ours_is_offline_for_the_broker_and_raised(broker: Broker) -> None:
    async def break_down(name: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        raise ZeroDivisionError

    async with Listener(broker) as live:
        mqtt = await sink(broker, answer=break_down).__aenter__()
        mqtt.publish(ONE)
        await live.wait("bms/pack/availability")
        await live.publish("bms/pack/request/any", qos=1)
        await live.wait("bms/pack/availability", lambda p: p == b"offline")
        with pytest.raises(ExceptionGroup) as fault:
            await mqtt.__aexit__(None, None, None)
    assert fault.value.split(ZeroDivisionError)[1] is None


async def test_a_retained_request_is_not_granted_again_with_every_connection(broker: Broker) -> None:
    asked = []

    async def note(name: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        asked.append(name)
        return {}

    async with Listener(broker) as live:
        await live.publish("bms/pack/request/old", b"{}", qos=1, retain=True)
        async with sink(broker, answer=note) as mqtt:
            mqtt.publish(ONE)
            await live.wait("bms/pack/availability")
            await live.publish("bms/pack/request/new", b"{}", qos=1)
            await live.wait("bms/pack/response/new")
    assert asked == ["new"]


@pytest.fixture
def secure_broker(tmp_path: Path) -> Iterator[Broker]:
    """Wants a name, a password and TLS; certificate and password stand in its folder."""
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    key, certificate, passwords = (tmp_path / name for name in ("key.pem", "cert.pem", "passwords"))
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
         "-keyout", key, "-out", certificate, "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "meter", "s3cret"], check=True, capture_output=True)
    (tmp_path / "secret").write_text("s3cret\n")
    locks = f"allow_anonymous false\npassword_file {passwords}\ncertfile {certificate}\nkeyfile {key}"
    broker = Broker(tmp_path, locks).start()
    yield broker
    broker.stop()


async def test_name_password_and_tls_reach_the_broker(secure_broker: Broker, tmp_path: Path) -> None:
    certificate = tmp_path / "cert.pem"
    settings = MqttSettings(
        url=f"mqtts://127.0.0.1:{secure_broker.port}",
        username="meter",
        password_file=tmp_path / "secret",
        ca_file=certificate,
    )
    tls = aiomqtt.TLSParameters(ca_certs=str(certificate))
    async with (
        Listener(secure_broker, "bms/#", username="meter", password="s3cret", tls_params=tls) as live,
        MqttSink(settings, "pack", refuse) as mqtt,
    ):
        mqtt.publish(ONE)
        await live.wait("bms/pack/state")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"url": "mqtt://me:secret@host:1883"}, "mqtt.username"),
        ({"url": "mqtt://host:99999"}, "mqtt.url"),
        ({"url": f"mqtt://{'a' * 64}.local"}, "mqtt.url = mqtt://a+.local: .*too long"),
        ({"url": "mqtt://broker..local"}, r"mqtt.url = mqtt://broker\.\.local: .*empty"),
        ({"url": "mqtt://[::1"}, r"mqtt.url = mqtt://\[::1: "),
        ({"password_file": Path("/nonexistent/password")}, "mqtt.password_file = /nonexistent/password"),
        ({"url": "mqtts://host", "ca_file": Path("/nonexistent/ca.pem")}, "mqtt.ca_file = /nonexistent/ca.pem"),
    ],
)
def test_settings_that_cannot_reach_a_broker_are_named(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(UserError, match=named):
        MqttSink(MqttSettings(**changes), "pack", refuse)


def test_every_payload_is_json_without_nan() -> None:
    for part in ONE:
        assert part is not None
        json.loads(part.model_dump_json(), parse_constant=pytest.fail)
