"""What the page of a fleet makes of what was heard: who is alive, how packs are spread, who needs attention, who works."""

import json

import pytest

from bms_estimator.fleet.heartbeat import Heartbeat
from bms_estimator.fleet.page.nats_feed import type_name
from bms_estimator.fleet.page.packs import ALIVE_S, LISTED, OTHER, UNLISTED, FleetPacks
from bms_estimator.fleet.page.view import FleetView
from bms_estimator.fleet.page.workers import FleetWorkers
from bms_estimator.model.input_faults import InputFault
from tests.fleet.many_packs import HOME, many, state
from tests.sinks.snapshots import ONE


def fine(**values: object) -> bytes:
    """Of a pack that needs no attention."""
    return state(**{"soc": 0.6, "soc_std": 0.01, "stability_margin": 0.5} | values)


def heard(states: dict[str, bytes], now_s: float = 0.0) -> FleetPacks:
    packs = FleetPacks()
    for name, data in states.items():
        packs.list_pack(name, "lfp 16s1p")
        packs.receive_state(name, data, now_s)
    return packs


def test_packs_are_alive_for_three_minutes_then_silent():
    packs = heard({"a": fine(), "b": fine()})
    packs.list_pack("c", "lfp 16s1p")
    packs.receive_state("b", fine(), 100.0)
    shown = packs.picture(100.0 + ALIVE_S - 1.0, 0.0)
    assert shown["packs"] == {"known": 3, "alive": 1, "silent": 2, "unlisted": 0}
    assert shown["concerns"]["silent"]["packs"] == [["c", None], ["a", 279.0]]
    assert shown["attention"] == 2


def test_who_has_not_been_listened_for_long_enough_is_not_called_silent():
    packs = heard({"a": fine()})
    shown = packs.picture(1000.0, 1000.0 - ALIVE_S)
    assert (shown["packs"]["alive"], shown["packs"]["silent"], shown["attention"]) == (0, 0, 0)


def test_a_pack_that_is_in_no_table_counts_once_it_is_heard_and_one_that_was_taken_out_no_more():
    packs = FleetPacks()
    packs.receive_parameters("guest", b"{}")
    assert packs.picture(1.0, 0.0)["packs"]["known"] == 0
    packs.receive_state("guest", fine(), 1.0)
    packs.list_pack("a", "lfp 16s1p")
    packs.list_pack("a", None)
    shown = packs.picture(1.0, 0.0)
    assert shown["packs"] == {"known": 1, "alive": 1, "silent": 0, "unlisted": 1}
    assert [t["type"] for t in shown["types"]] == [UNLISTED]


def test_packs_are_spread_by_type_over_soc_and_its_uncertainty():
    packs = heard({"a": fine(soc=-0.01), "b": fine(soc=0.05), "c": fine(soc=1.0), "d": fine(soc=None, soc_std=None)})
    packs.receive_state("e", fine(soc_std=0.7), 0.0)
    home, guests = packs.picture(1.0, 0.0)["types"]
    assert (home["packs"], home["alive"]) == (4, 4)
    assert {i: n for i, n in enumerate(home["soc"]) if n} == {0: 1, 1: 1, 19: 1}
    assert home["soc_median"] == 0.05
    assert home["soc_std_median"] == 0.01
    assert {i: n for i, n in enumerate(home["soc_std"]) if n} == {2: 3}
    assert guests["type"] == UNLISTED
    assert guests["soc_std"][-1] == 1


def test_rare_types_are_taken_together():
    packs = FleetPacks()
    for number in range(12):
        packs.list_pack(f"p{number}", f"type {number}")
    types = packs.picture(0.0, 0.0)["types"]
    assert (len(types), types[-1]["type"], types[-1]["packs"]) == (9, OTHER, 4)


def test_who_needs_attention_is_listed_by_how_much_and_counted_once():
    packs = heard(
        {
            "low": fine(soc=0.04, stability_margin=-0.02),
            "lower": fine(soc=0.02, stability_margin=0.01),
            "wide": fine(soc_std=0.09),
            "fine": fine(),
            "dumb": fine(soc=None, soc_std=None, stability_margin=None),
        }
    )
    both = InputFault.CAPACITY | InputFault.SIGN_OF_CURRENT
    packs.receive_hour("wide", json.dumps({"suspects": int(both)}).encode())
    packs.receive_hour("fine", json.dumps({"suspects": int(InputFault.OCV)}).encode())
    shown = packs.picture(1.0, 0.0)
    concerns = shown["concerns"]
    assert {kind: each["count"] for kind, each in concerns.items()} == {
        "margin": 2,
        "soc": 2,
        "uncertain": 1,
        "suspects": 2,
        "silent": 0,
    }
    assert [name for name, _ in concerns["margin"]["packs"]] == ["low", "lower", "wide", "fine"]
    assert concerns["soc"]["packs"][0] == ["lower", 0.02]
    assert concerns["uncertain"]["packs"][0] == ["wide", 0.09]
    assert concerns["suspects"]["packs"] == [["wide", "sign of current, capacity"], ["fine", "ocv"]]
    assert shown["attention"] == 4


def test_of_many_the_worst_are_found():
    fleet = many(5000)
    packs = heard({pack.name: pack.state for pack in fleet})
    shown = packs.picture(1.0, 0.0)
    socs = sorted((json.loads(pack.state)["soc"], pack.name) for pack in fleet)
    assert [(value, name) for name, value in shown["concerns"]["soc"]["packs"]] == socs[:LISTED]
    assert sum(sum(t["soc"]) for t in shown["types"]) == 5000
    assert len(json.dumps(shown)) < 10_000


def test_names_are_found_by_how_they_begin():
    packs = heard({f"van-{n:03d}": fine() for n in range(100)})
    packs.list_pack("attic", "lfp 16s1p")
    assert packs.find("van-01") == [f"van-{n:03d}" for n in range(10, 20)]
    assert packs.find("att") == ["attic"]
    assert packs.find("x") == []
    assert len(packs.find("")) == LISTED


def test_all_that_is_known_of_one_pack():
    packs = heard({"a": fine()}, 5.0)
    packs.receive_parameters("a", ONE.parameters.model_dump_json().encode())
    packs.receive_hour("a", json.dumps({"suspects": int(InputFault.OFFSET)}).encode())
    found = packs.one("a", 7.0)
    assert found
    assert (found["pack"], found["type"], found["heard_s"]) == ("a", "lfp 16s1p", 2.0)
    assert found["state"] == json.loads(fine())
    assert found["parameters"] == json.loads(ONE.parameters.model_dump_json())
    assert "zero of the current sensor" in found["suspects"]
    assert packs.one("b", 7.0) is None


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"1", b'{"soc": NaN}', b"\xff", b"[" * 60_000])
def test_what_is_no_state_is_counted_and_left_out(data: bytes) -> None:
    packs = FleetPacks()
    packs.receive_state("a", data, 0.0)
    packs.receive_hour("a", data)
    packs.receive_parameters("b", data)
    assert packs.damaged == 1
    assert packs.picture(0.0, 0.0)["packs"]["known"] == 0
    assert packs.one("b", 0.0)["parameters"] is None


@pytest.mark.parametrize("value", ["x", True, [], 1e400])
def test_a_value_that_is_no_number_is_not_known(value: object) -> None:
    packs = heard({"a": json.dumps({"soc": value, "soc_std": 0.01}).replace("Infinity", "1e400").encode()})
    shown = packs.picture(0.0, 0.0)
    assert json.dumps(shown, allow_nan=False)
    assert sum(shown["types"][0]["soc"]) == 0


def beat(worker: str, *partitions: int, **values: object) -> Heartbeat:
    return Heartbeat.model_validate({"id": worker, "started_s": 0.0, "partitions": partitions, **values})


def test_who_holds_which_partition_and_which_nobody_holds():
    workers = FleetWorkers(4)
    workers.hear(beat("b", 2, 9, lag_s=3.0), 0.0)
    workers.hear(beat("a", 0, 2, lag_s=1.0), 1.0)
    shown = workers.picture(2.0)
    assert [each["id"] for each in shown["workers"]] == ["a", "b"]
    assert shown["holders"] == [0, -1, 1, -1]
    assert (shown["unheld"], shown["twice"], shown["lag_s"]) == ([1, 3], [2], 3.0)
    shown = workers.picture(5.5)
    assert [(each["id"], each["alive"]) for each in shown["workers"]] == [("a", True), ("b", False)]
    assert (shown["holders"], shown["lag_s"]) == ([0, -1, 0, -1], 1.0)
    assert workers.picture(400.0)["workers"] == []


def test_rates_are_of_late_and_begin_anew_with_a_worker():
    workers = FleetWorkers(1)
    for second in range(30):
        faster = max(second - 15, 0)
        workers.hear(beat("a", 0, blocks=second + 9 * faster, samples=60 * second, cpu_s=0.5 * second), float(second))
    (line,) = workers.picture(29.0)["workers"]
    assert (line["blocks_per_s"], line["samples_per_s"], line["cpu"]) == (10.0, 60.0, 0.5)
    workers.hear(beat("a", 0, blocks=1), 30.0)
    (line,) = workers.picture(30.0)["workers"]
    assert line["blocks_per_s"] is None


def test_unknown_packs_are_named_until_the_table_knows_them_or_no_worker_has_any():
    view = FleetView(1, 0.0)
    view.receive_worker(beat("w", 0, unknown=("x", "held"), unknown_count=7).model_dump_json().encode(), 0.0)
    view.receive_unknown("x", "no row")
    view.receive_unknown("y", "")
    shown = view.picture(3.0, 0.0)
    assert shown["concerns"]["unknown"] == {"count": 7, "packs": [["y", ""], ["x", "no row"], ["held", ""]]}
    assert shown["attention"] == 7
    view.know("y", "lfp 1s1p")
    assert len(view.picture(3.0, 0.0)["concerns"]["unknown"]["packs"]) == 2
    view.receive_worker(beat("w", 0).model_dump_json().encode(), 4.0)
    assert view.picture(4.0, 0.0)["concerns"]["unknown"] == {"count": 0, "packs": []}


def test_states_are_counted_by_the_second():
    view = FleetView(1, 0.0)
    for second in range(20):
        for _ in range(5):
            view.packs.receive_state("a", fine(), float(second))
        shown = view.picture(second + 1.0, 0.0)
    assert shown["states_per_s"] == 5.0


def test_heartbeats_of_others_are_counted_and_left_out():
    view = FleetView(1, 0.0)
    view.receive_worker(b"{}", 0.0)
    assert view.picture(0.0, 0.0)["damaged"] == 1


def test_after_a_break_workers_are_heard_anew_and_packs_are_as_they_were():
    view = FleetView(1, 0.0)
    view.receive_worker(beat("w", 0).model_dump_json().encode(), 0.0)
    view.packs.receive_state("a", fine(), 0.0)
    view.begin(1000.0)
    shown = view.picture(1001.0, 0.0)
    assert shown["workers"] == []
    assert shown["packs"] == {"known": 1, "alive": 0, "silent": 0, "unlisted": 1}
    assert shown["listening_s"] == 1.0


def test_a_type_is_called_by_its_cell_and_how_many():
    assert type_name(HOME) == "lfp 16s1p 280 Ah"
    assert type_name("series: must be above 0") == "wrong rows"
