"""Start of the add-on: completes the settings with Home Assistant's broker, and becomes the service."""

import json
import os
import sys
import urllib.request
from pathlib import Path

import tomlkit

SETTINGS = Path("/config")
"""Folder of the add-on's settings, which the user edits."""
DATA = Path("/data")
"""Folder of the add-on's own files."""
SUPERVISOR = "http://supervisor"
TIMEOUT_S = 10.0
"""Timeout of a request to the Supervisor [s]."""


def broker_of_home_assistant(supervisor: str, token: str) -> dict[str, object]:
    """Return host, port, username, password and use of TLS of the broker that Home Assistant offers to add-ons."""
    request = urllib.request.Request(f"{supervisor}/services/mqtt", headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=TIMEOUT_S) as response:
        return dict(json.load(response)["data"])


def with_broker(pack: Path, data: Path, supervisor: str, token: str) -> Path:
    """Return a settings file with a broker: the user's file, or a copy with Home Assistant's broker.

    Args:
        pack: The user's settings file. It is returned if it has a section [mqtt].
        data: Folder for the copy and for the broker's password.
        supervisor: URL of the Supervisor.
        token: Token for the Supervisor.
    """
    settings = tomlkit.parse(pack.read_text(encoding="utf-8"))
    if "mqtt" in settings:
        return pack
    broker = broker_of_home_assistant(supervisor, token)
    password = data / "mqtt-password"
    password.touch(mode=0o600)
    password.write_text(str(broker["password"]), encoding="utf-8")
    settings["mqtt"] = {
        "url": f"{'mqtts' if broker.get('ssl') else 'mqtt'}://{broker['host']}:{broker['port']}",
        "username": broker["username"],
        "password_file": str(password),
    }
    completed = data / pack.name
    completed.write_text(tomlkit.dumps(settings), encoding="utf-8")
    return completed


def main() -> None:
    """Run the service. Write a settings file with all defaults if the user has none yet."""
    options = json.loads((DATA / "options.json").read_text(encoding="utf-8"))
    pack = SETTINGS / options["pack_file"]
    if not pack.exists():
        os.execvp("bms-estimator", ["bms-estimator", "config", "init", str(pack)])
    try:
        completed = with_broker(pack, DATA, SUPERVISOR, os.environ["SUPERVISOR_TOKEN"])
    except OSError as error:
        sys.exit(f"Home Assistant offers no MQTT broker ({error}): install the add-on Mosquitto broker, or set [mqtt]")
    os.execvp("bms-estimator", ["bms-estimator", "run", "--no-view", str(completed)])


if __name__ == "__main__":
    main()
