"""SIGHUP: what can be changed while it runs is, what cannot is said, and nothing is lost by a file that is wrong."""

import asyncio
import os
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from bms_estimator.checkpoint.checkpoint_file import CheckpointFile
from bms_estimator.cli.main import main
from bms_estimator.model.errors import UserError
from bms_estimator.mqtt.delivery_stats import DeliveryStats
from bms_estimator.process.signals import stop_on_signal
from bms_estimator.process.systemd import SystemdNotifier
from bms_estimator.service.live_loop import run_estimation_loop
from bms_estimator.service.settings_reload import SettingsReload, reload_on_hangup
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sinks.mqtt.requests import RequestDispatcher
from tests.checkpoint.test_checkpoint import CELL, SETTINGS, edited
from tests.collector import Collector
from tests.patience import LONG_S
from tests.scripted_source import ScriptedSource


def logged(lines: list[Any], event: str) -> list[dict[str, Any]]:
    return [line for line in lines if line["event"] == event]


async def test_what_cannot_be_changed_is_said_each_time_and_what_can_is_changed_once() -> None:
    now = edited("publish", rate_hz=2.0).model_copy(update={"log": SETTINGS.log.model_copy(update={"level": "error"})})
    now = now.model_copy(update={"pack": now.pack.model_copy(update={"series": 2})})
    reload, taken = SettingsReload(SETTINGS, lambda: now), []
    reload.on_change("publish.rate_hz", taken.append)
    with capture_logs() as lines:
        assert await reload.reload() == ["pack.series", "log.level"]
        assert await reload.reload() == ["pack.series", "log.level"]
    assert taken == [2.0]
    first, second = logged(lines, "settings reloaded")
    assert first["changed"] == ["publish.rate_hz"]
    assert second["changed"] == []
    assert first["need a restart"] == second["need a restart"] == ["pack.series", "log.level"]


async def test_a_section_that_is_new_needs_a_restart() -> None:
    reload = SettingsReload(
        SETTINGS, lambda: Settings.model_validate({**SETTINGS.model_dump(by_alias=True), "mqtt": {}})
    )
    assert "mqtt.url" in await reload.reload()


async def test_a_file_that_is_wrong_changes_nothing() -> None:
    def read() -> Settings:
        raise UserError("pack.toml: pack.series = 0")

    reload = SettingsReload(SETTINGS, read)
    with capture_logs() as lines:
        assert await reload.reload() == []
    (line,) = lines
    assert line["reason"] == "pack.toml: pack.series = 0"


async def test_a_file_that_hangs_ends_no_reload_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bms_estimator.service.settings_reload.HUNG_S", 0.1)
    file = tmp_path / "pack.toml"
    os.mkfifo(file)  # whoever opens it for reading waits for a writer
    reload = SettingsReload(SETTINGS, lambda: load_settings(file))
    with capture_logs() as lines:
        assert await asyncio.wait_for(reload.reload(), LONG_S) == []
    assert "nothing could be read in 0.1 s" in lines[0]["reason"]
    monkeypatch.undo()
    file.unlink()
    file.write_text("[pack]\nseries = 2\n")
    assert "pack.series" in await asyncio.wait_for(reload.reload(), LONG_S)


def test_commands_that_are_allowed_may_change() -> None:
    requests = RequestDispatcher(DeliveryStats(), ["set_soc"])
    requests.allow([])
    assert b"not allowed" in (asyncio.run(requests.handle("set_soc", b"")) or b"")


async def test_a_running_service_takes_another_rate_at_a_signal_and_tells_systemd(tmp_path: Path) -> None:
    now = SETTINGS
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        notifier = SystemdNotifier([SETTINGS.pack.name], {"NOTIFY_SOCKET": str(tmp_path / "notify")})
        reload, source, sink = SettingsReload(SETTINGS, lambda: now), ScriptedSource(), Collector()
        reload_on_hangup([reload])
        stop = stop_on_signal()
        edges = {"source": source, "sinks": [sink], "stop": stop, "reload": reload, "notifier": notifier}
        file = CheckpointFile(tmp_path, SETTINGS, CELL)
        task = asyncio.create_task(run_estimation_loop(SETTINGS, CELL, checkpoint=file, **edges))
        await sink.until(lambda s: s.info.publish_rate_hz == 10.0)
        heard: list[str] = []
        now = edited("publish", rate_hz=5.0)
        os.kill(os.getpid(), signal.SIGHUP)
        async with asyncio.timeout(LONG_S):
            while not any(state.startswith("RELOADING=1\nMONOTONIC_USEC=") for state in heard):
                heard.append((await asyncio.get_running_loop().sock_recv(systemd, 4096)).decode())
            while not heard[-1].startswith("READY=1\n"):
                heard.append((await asyncio.get_running_loop().sock_recv(systemd, 4096)).decode())
        await sink.until(lambda s: s.info.publish_rate_hz == 5.0)
        assert not stop.is_set()
        source.finish()
        await asyncio.wait_for(task, LONG_S)
        asyncio.get_running_loop().remove_signal_handler(signal.SIGHUP)


def test_a_hangup_before_samples_are_taken_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    async def serve(*_: Any, reload: SettingsReload, **__: Any) -> None:
        asked.append(reload.asked.is_set())

    monkeypatch.setattr("bms_estimator.cli.live.run.load_kernels", lambda: os.kill(os.getpid(), signal.SIGHUP))
    monkeypatch.setattr("bms_estimator.cli.live.run.run_pack_service", serve)
    monkeypatch.setattr("bms_estimator.cli.live.run.configure_logs", lambda *_: None)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    (tmp_path / "pack.toml").write_text('[pack]\ncell = "chen_mora"\n')
    with pytest.raises(SystemExit) as ended:
        main(["run", str(tmp_path / "pack.toml")])
    assert not ended.value.code
    assert asked == [True]


async def test_without_settings_to_read_a_hangup_is_a_clean_end() -> None:
    stop = stop_on_signal()
    os.kill(os.getpid(), signal.SIGHUP)
    await asyncio.wait_for(stop.wait(), LONG_S)
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().remove_signal_handler(number)
