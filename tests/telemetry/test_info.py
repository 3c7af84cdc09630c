"""Topic ``info``: name of the observer's law and of its Nussbaum function."""

import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.settings.observer import ObserverSettings
from bms_estimator.settings.pack import Settings
from bms_estimator.telemetry.state import make_info_payload


@pytest.mark.parametrize(
    ("law", "observer"), [("learning", "learning"), ("improved", "improved, k2-cos"), ("scheme-1", "scheme-1, k2-cos")]
)
def test_the_nussbaum_function_is_reported_for_the_laws_that_have_one(law: str, observer: str) -> None:
    settings = Settings(observer=ObserverSettings.model_validate({"law": law, "nussbaum": "k2-cos"}))
    info = make_info_payload(settings, load_cell("chen_mora"), {}, 0.0, temperature_sensor=False)
    assert info.observer == observer
