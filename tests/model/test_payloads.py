"""JSON of payloads, which is built once for each object."""

from bms_estimator.model.payloads import Alarm

RAISED = Alarm(
    name="soc_low", severity="warning", active=True, latched=False, since=None, value=0.1, limit=0.1, unit=None, text=""
)


def test_json_is_built_once() -> None:
    assert RAISED.json_bytes is RAISED.json_bytes


def test_a_changed_copy_has_its_own_json() -> None:
    assert b'"value":0.1' in RAISED.json_bytes
    assert b'"value":0.2' in RAISED.model_copy(update={"value": 0.2}).json_bytes


def test_payloads_with_and_without_json_are_equal() -> None:
    assert RAISED.json_bytes
    assert RAISED.model_copy() == RAISED
