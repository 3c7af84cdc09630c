"""The benchmark of MQTT sessions with a few sessions."""

import pytest

from tests.benchmarks.fleet.mqtt_sessions import measure, parse_arguments
from tests.patience import LONG_S

SESSIONS = 40


@pytest.mark.thorough
async def test_sessions_reconnect_after_a_kill_and_after_a_drop_and_no_block_is_lost() -> None:
    values = dict[str, str]()
    times = ("--connect-s", 0, "--steady-s", 0.5, "--block-s", 1, "--limit-s", LONG_S, "--delays", "constant")
    options = ("--sessions", SESSIONS, "--processes", 1, "--partitions", 2, "--persistent", *times)
    assert await measure(parse_arguments(*options), values.__setitem__)
    for name in ("first connections", "killed", "dropped"):
        assert values[f"{name}: connected"].startswith(f"all {SESSIONS} in ")
    assert values["$MQTT_sess"].startswith(f"{SESSIONS} messages")
    assert values["$MQTT_msgs"].endswith(f" {SESSIONS} consumers")
