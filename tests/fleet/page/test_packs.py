"""Data of the fleet page: live packs, their distribution, packs that need attention, and workers."""

import json

import pytest

from bms_estimator.fleet.fleet_workers import FleetWorkers
from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.nats.dead_packs import DeadPacks
from bms_estimator.fleet.page.nats_feed import type_name
from bms_estimator.fleet.page.packs import MAX_LISTED, OTHER, SILENT_S, UNLISTED, FleetPacks
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.model.input_faults import InputFault
from tests.fleet.published_states import HOME, make_packs, state
from tests.sinks.snapshots import CELL_SNAPSHOT


def healthy(**values: object) -> bytes:
    """Return the state of a pack without any concern."""
    return state(**{"soc": 0.6, "soc_std": 0.01, "stability_margin": 0.5} | values)


def receive_states(states: dict[str, bytes], now_s: float = 0.0) -> FleetPacks:
    """Return packs of one type that are in the table of packs and have published these states."""
    packs = FleetPacks()
    for name, data in states.items():
        packs.set_type(name, "lfp 16s1p")
        packs.receive_state(name, data, now_s)
    return packs


def test_pack_that_never_sent_a_state_or_none_within_three_minutes_is_silent():
    packs = receive_states({"a": healthy(), "b": healthy()})
    packs.set_type("c", "lfp 16s1p")
    packs.receive_state("b", healthy(), 100.0)
    overview = packs.overview(100.0 + SILENT_S - 1.0, 0.0)
    assert overview["packs"] == {"known": 3, "alive": 1, "silent": 2, "uncertain": 0}
    assert overview["concerns"]["silent"]["packs"] == [["c", None], ["a", 279.0]]
    assert overview["attention_count"] == 2


def test_pack_is_not_silent_within_three_minutes_after_the_start_of_the_page():
    packs = receive_states({"a": healthy()})
    overview = packs.overview(1000.0, 1000.0 - SILENT_S)
    assert (overview["packs"]["alive"], overview["packs"]["silent"], overview["attention_count"]) == (0, 0, 0)


def test_pack_outside_the_table_counts_after_its_first_state_and_a_removed_pack_does_not():
    packs = FleetPacks()
    packs.receive_parameters("guest", b"{}")
    assert packs.overview(1.0, 0.0)["packs"]["known"] == 0
    packs.receive_state("guest", healthy(), 1.0)
    packs.set_type("a", "lfp 16s1p")
    packs.set_type("a", None)
    overview = packs.overview(1.0, 0.0)
    assert overview["packs"] == {"known": 1, "alive": 1, "silent": 0, "uncertain": 0}
    assert [t["type"] for t in overview["types"]] == [UNLISTED]


def test_soc_and_its_std_are_counted_in_bins_for_each_type():
    packs = receive_states(
        {"a": healthy(soc=-0.01), "b": healthy(soc=0.05), "c": healthy(soc=1.0), "d": healthy(soc=None, soc_std=None)}
    )
    packs.receive_state("e", healthy(soc_std=0.7), 0.0)
    home, unlisted = packs.overview(1.0, 0.0)["types"]
    assert (home["packs"], home["alive"]) == (4, 4)
    # by index of the bin of 5 %: -0.01 is in the first bin, 1.0 in the last one
    assert {i: n for i, n in enumerate(home["soc"]) if n} == {0: 1, 1: 1, 19: 1}
    assert home["soc_median"] == 0.05
    assert home["soc_std_median"] == 0.01
    assert {i: n for i, n in enumerate(home["soc_std"]) if n} == {2: 3}  # 0.01 is the lower edge of bin 2
    assert unlisted["type"] == UNLISTED
    assert unlisted["soc_std"][-1] == 1


def test_types_beyond_the_eight_most_frequent_are_combined():
    packs = FleetPacks()
    for number in range(12):
        packs.set_type(f"p{number}", f"type {number}")
    types = packs.overview(0.0, 0.0)["types"]
    assert (len(types), types[-1]["type"], types[-1]["packs"]) == (9, OTHER, 4)


def test_packs_with_concerns_are_ranked_and_count_once_for_attention():
    packs = receive_states(
        {
            "low": healthy(soc=0.04, stability_margin=-0.02),
            "lower": healthy(soc=0.02, stability_margin=0.01),
            "wide": healthy(soc_std=0.09),
            "healthy": healthy(),
            "unknown": healthy(soc=None, soc_std=None, stability_margin=None),
        }
    )
    faults = InputFault.CAPACITY | InputFault.SIGN_OF_CURRENT
    packs.receive_hour_summary("wide", json.dumps({"suspects": int(faults)}).encode())
    packs.receive_hour_summary("healthy", json.dumps({"suspects": int(InputFault.OCV)}).encode())
    overview = packs.overview(1.0, 0.0)
    concerns = overview["concerns"]
    assert {kind: each["count"] for kind, each in concerns.items()} == {
        "margin": 2,
        "soc": 2,
        "suspects": 2,
        "silent": 0,
    }
    # listed are the smallest margins, also those above the limit
    assert [name for name, _ in concerns["margin"]["packs"]] == ["low", "lower", "wide", "healthy"]
    assert concerns["soc"]["packs"][0] == ["lower", 0.02]
    assert concerns["suspects"]["packs"] == [["wide", "sign of current, capacity"], ["healthy", "ocv"]]
    assert overview["attention_count"] == 4


def test_uncertain_packs_of_a_new_fleet_are_counted_and_need_no_attention():
    packs = receive_states({f"p{n}": healthy(soc_std=0.09) for n in range(133)} | {"known": healthy()})
    overview = packs.overview(1.0, 0.0)
    assert (overview["packs"]["uncertain"], overview["attention_count"]) == (133, 0)


def test_only_the_packs_with_the_lowest_soc_are_listed():
    fleet = make_packs(5000)
    packs = receive_states({pack.name: pack.state for pack in fleet})
    overview = packs.overview(1.0, 0.0)
    socs = sorted((json.loads(pack.state)["soc"], pack.name) for pack in fleet)
    assert [(value, name) for name, value in overview["concerns"]["soc"]["packs"]] == socs[:MAX_LISTED]
    assert sum(sum(t["soc"]) for t in overview["types"]) == 5000
    assert len(json.dumps(overview)) < 10_000


def test_packs_are_found_by_prefix():
    packs = receive_states({f"van-{n:03d}": healthy() for n in range(100)})
    packs.set_type("attic", "lfp 16s1p")
    assert packs.find("van-01") == [f"van-{n:03d}" for n in range(10, 20)]
    assert packs.find("att") == ["attic"]
    assert packs.find("x") == []
    assert len(packs.find("")) == MAX_LISTED


def test_details_of_a_pack_have_its_state_parameters_and_suspected_faults():
    packs = receive_states({"a": healthy()}, 5.0)
    packs.receive_parameters("a", CELL_SNAPSHOT.parameters.model_dump_json().encode())
    packs.receive_hour_summary("a", json.dumps({"suspects": int(InputFault.OFFSET)}).encode())
    details = packs.details("a", 7.0)
    assert details
    assert (details["pack"], details["type"], details["heard_s"]) == ("a", "lfp 16s1p", 2.0)
    assert details["state"] == json.loads(healthy())
    assert details["parameters"] == json.loads(CELL_SNAPSHOT.parameters.model_dump_json())
    assert "zero of the current sensor" in details["suspects"]
    assert packs.details("b", 7.0) is None


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"1", b'{"soc": NaN}', b"\xff", b"[" * 60_000])
def test_invalid_messages_are_skipped(data: bytes) -> None:
    packs = FleetPacks()
    packs.receive_state("a", data, 0.0)
    packs.receive_hour_summary("a", data)
    packs.receive_parameters("b", data)
    assert packs.overview(0.0, 0.0)["packs"]["known"] == 0
    assert packs.details("b", 0.0)["parameters"] is None


@pytest.mark.parametrize("value", ["x", True, [], 1e400])
def test_value_that_is_not_a_number_is_unknown(value: object) -> None:
    packs = receive_states({"a": json.dumps({"soc": value, "soc_std": 0.01}).replace("Infinity", "1e400").encode()})
    overview = packs.overview(0.0, 0.0)
    assert json.dumps(overview, allow_nan=False)
    assert sum(overview["types"][0]["soc"]) == 0


def heartbeat(worker: str, *partitions: int, **values: object) -> Heartbeat:
    """Return the heartbeat of a worker that holds these partitions."""
    return Heartbeat.model_validate({"id": worker, "started_s": 0.0, "partitions": partitions, **values})


def test_partitions_with_no_or_two_live_workers_are_reported():
    workers = FleetWorkers(4)
    workers.receive(heartbeat("b", 2, 9, lag_s=3.0), 0.0)  # there is no partition 9
    workers.receive(heartbeat("a", 0, 2, lag_s=1.0), 1.0)
    overview = workers.overview(2.0)
    assert [each["id"] for each in overview["workers"]] == ["a", "b"]
    assert overview["holders"] == [0, -1, 1, -1]
    assert (overview["unheld"], overview["twice"], overview["lag_s"]) == ([1, 3], [2], 3.0)
    overview = workers.overview(5.5)  # the heartbeat of b is too old
    assert [(each["id"], each["alive"]) for each in overview["workers"]] == [("a", True), ("b", False)]
    assert (overview["holders"], overview["lag_s"]) == ([0, -1, 0, -1], 1.0)
    assert workers.overview(400.0)["workers"] == []


def test_partitions_that_all_workers_refuse_and_packs_with_dead_letters_are_named():
    view = FleetView(2, 0.0)
    refused = [{"partition": number, "format": 3} for number in range(2)]
    old = heartbeat("old", refused=refused)
    view.dead_packs = DeadPacks(2, (("x", "version 2"),))
    view.receive_worker(old.model_dump_json().encode(), 0.0)
    overview = view.overview(1.0, 0.0)
    assert overview["refused"] == [0, 1]
    assert overview["workers"][0]["refused"] == [[0, 3], [1, 3]]
    assert overview["concerns"]["dead"] == {"count": 2, "packs": (("x", "version 2"),)}
    assert overview["attention_count"] == 2
    view.receive_worker(heartbeat("later", 0).model_dump_json().encode(), 1.0)
    assert view.overview(2.0, 0.0)["refused"] == [1]


def test_rates_of_a_worker_are_those_of_the_last_seconds_and_unknown_after_its_restart():
    workers = FleetWorkers(1)
    for second in range(30):
        seconds_at_10_blocks = max(second - 15, 0)  # at first one block a second
        workers.receive(
            heartbeat("a", 0, blocks=second, samples=60 * (second + 9 * seconds_at_10_blocks)),
            float(second),
        )
    (row,) = workers.overview(29.0)["workers"]
    assert row["samples_per_s"] == 600.0
    workers.receive(heartbeat("a", 0, blocks=1, samples=60), 30.0)
    (row,) = workers.overview(30.0)["workers"]
    assert row["samples_per_s"] is None


def test_unknown_packs_are_listed_until_they_are_known_or_no_worker_has_any():
    view = FleetView(1, 0.0)
    view.receive_worker(heartbeat("w", 0, unknown=("x", "held"), unknown_count=7).model_dump_json().encode(), 0.0)
    view.receive_unknown("x", "no row")
    view.receive_unknown("y", "")
    overview = view.overview(3.0, 0.0)
    assert overview["concerns"]["unknown"] == {"count": 7, "packs": [["y", ""], ["x", "no row"], ["held", ""]]}
    assert overview["attention_count"] == 7
    view.set_pack_type("y", "lfp 1s1p")
    assert len(view.overview(3.0, 0.0)["concerns"]["unknown"]["packs"]) == 2
    view.receive_worker(heartbeat("w", 0).model_dump_json().encode(), 4.0)
    assert view.overview(4.0, 0.0)["concerns"]["unknown"] == {"count": 0, "packs": []}


def test_packs_with_a_wrong_clock_are_listed_with_the_largest_errors_first():
    view = FleetView(2, 0.0)
    for worker, errors in (("v", {"a": 900.0}), ("w", {"b": -4e8})):
        beat = heartbeat(worker, 0, clock_errors=errors, clock_error_count=3)
        view.receive_worker(beat.model_dump_json().encode(), 0.0)
    overview = view.overview(1.0, 0.0)
    assert overview["concerns"]["clock"] == {"count": 6, "packs": [["b", -4e8], ["a", 900.0]]}
    assert overview["attention_count"] == 6


def test_rate_of_received_states_is_measured():
    view = FleetView(1, 0.0)
    for second in range(20):
        for _ in range(5):
            view.packs.receive_state("a", healthy(), float(second))
        overview = view.overview(second + 1.0, 0.0)
    assert overview["states_per_s"] == 5.0


def test_invalid_heartbeats_are_skipped():
    view = FleetView(1, 0.0)
    view.receive_worker(b"{}", 0.0)
    view.receive_worker(heartbeat("w", 0).model_dump_json().encode().replace(b"0.0", b"NaN"), 0.0)
    assert json.loads(view.overview_json(0.0, 0.0))["workers"] == []


def test_new_connection_clears_workers_but_not_packs():
    view = FleetView(1, 0.0)
    view.receive_worker(heartbeat("w", 0).model_dump_json().encode(), 0.0)
    view.packs.receive_state("a", healthy(), 0.0)
    view.set_connected(1000.0)
    overview = view.overview(1001.0, 0.0)
    assert overview["workers"] == []
    assert overview["packs"] == {"known": 1, "alive": 0, "silent": 0, "uncertain": 0}
    assert overview["listening_s"] == 1.0


def test_type_name_has_cell_layout_and_capacity():
    assert type_name(HOME) == "lfp 16s1p 280 Ah"
    assert type_name("series: must be above 0") == "wrong rows"  # a row with an error is replaced by its text
