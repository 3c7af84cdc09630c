"""JSON of payloads: each object builds its JSON once."""

from bms_estimator.model.payloads.snapshot import Alarm

RAISED = Alarm(
    name="soc_low", severity="warning", active=True, latched=False, since=None, value=0.1, limit=0.1, unit=None, text=""
)


def test_the_json_of_a_payload_is_built_once() -> None:
    assert RAISED.json_bytes is RAISED.json_bytes


def test_a_changed_copy_has_its_own_json() -> None:
    assert b'"value":0.1' in RAISED.json_bytes
    assert b'"value":0.2' in RAISED.model_copy(update={"value": 0.2}).json_bytes


def test_a_payload_whose_json_has_been_built_equals_one_without_json() -> None:
    assert RAISED.json_bytes
    assert RAISED.model_copy() == RAISED
