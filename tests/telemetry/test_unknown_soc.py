"""Alarms while the SOC is not known, or there is no stability margin."""

import json
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.records import TRACE
from bms_estimator.model.arrays import NO_CELLS, SAMPLE
from bms_estimator.model.payloads.snapshot import Alarm
from bms_estimator.telemetry.alarms.alarm_list import NO_VALUE
from bms_estimator.telemetry.alarms.evaluator import AlarmEvaluator
from bms_estimator.telemetry.state import ALWAYS_STABLE, NOT_IDENTIFIED, UNKNOWN_SOC
from tests.telemetry.alarm_captures import PACK, WALL_S, settings


class Pack:
    """Alarms of a pack whose estimates are given."""

    def __init__(self, saved_state: str = "", **soc_low: Any) -> None:
        self.evaluator = AlarmEvaluator(settings({"soc_low": soc_low}), Estimator(PACK))
        self.evaluator.restore(saved_state)
        self._time_s = 0.0

    def estimate(
        self, soc: float, soc_std: float, seconds: int = 100, delta: float = 0.01, delta_valid: bool = True
    ) -> None:
        """Evaluate an estimate that is constant for some time, with one sample a second.

        The parameters of ``delta`` are valid if ``delta_valid``.
        """
        trace, samples = np.zeros(seconds, TRACE), np.zeros(seconds, SAMPLE)
        trace["time_s"] = samples["time_s"] = self._time_s + np.arange(seconds)
        samples["voltage_v"], samples["temperature_c"] = 7.4, 25.0
        trace["lock"], trace["soc"], trace["soc_std"], trace["delta_1"], trace["delta_2"] = (
            1,
            soc,
            soc_std,
            delta,
            delta,
        )
        trace["stability_margin"] = soc - delta if delta > 0.0 and delta_valid else np.nan
        self._time_s += seconds
        self.evaluator.evaluate(samples, trace, NO_CELLS, WALL_S + self._time_s)

    def alarm(self, name: str = "soc_low") -> Alarm:
        """Return the payload of an alarm."""
        return next(alarm for alarm in self.evaluator.report() if alarm.name == name)


def test_no_alarm_is_raised_at_a_first_start_with_an_unknown_soc() -> None:
    pack = Pack(severity="critical")
    pack.estimate(soc=0.42, soc_std=0.415)
    pack.estimate(soc=0.01, soc_std=0.13)
    assert (pack.evaluator.active, pack.evaluator.changes(), pack.evaluator.unwatched_critical) == ((), [], ())
    for name in ("soc_low", "stability_margin_low"):
        alarm = pack.alarm(name)
        assert (alarm.watched, alarm.unwatched_reason, alarm.unknown_reason) == (True, None, UNKNOWN_SOC)
    pack.estimate(soc=0.04, soc_std=0.1)
    assert pack.evaluator.active == ("soc_low", "stability_margin_low")
    assert pack.alarm().unknown_reason is None


@pytest.mark.parametrize("latch", [False, True])
@pytest.mark.parametrize("restart", [False, True])
def test_a_raised_alarm_lasts_until_the_soc_is_known_and_above_the_clear_level(latch: bool, restart: bool) -> None:
    pack = Pack(latch=latch)
    pack.estimate(soc=0.05, soc_std=0.02)
    assert pack.alarm().active
    if restart:
        pack = Pack(pack.evaluator.saved_state, latch=latch)
    pack.estimate(soc=0.9, soc_std=0.3, seconds=1000)
    pack.estimate(soc=0.9, soc_std=0.13, seconds=1000)
    assert (pack.alarm().active, pack.alarm().latched, pack.alarm().unknown_reason) == (True, False, UNKNOWN_SOC)
    assert json.loads(pack.evaluator.saved_state)["soc_low"]["gone"] is False
    pack.estimate(soc=0.2, soc_std=0.1)  # the SOC minus its std is below the clear level
    assert pack.alarm().active
    pack.estimate(soc=0.9, soc_std=0.1)
    assert (pack.alarm().active, pack.alarm().latched) == (latch, latch)


def test_an_acknowledged_alarm_does_not_end_while_the_soc_is_not_known() -> None:
    pack = Pack(latch=True)
    pack.estimate(soc=0.05, soc_std=0.02)
    pack.estimate(soc=0.9, soc_std=0.3)
    pack.evaluator.acknowledge("soc_low")
    assert pack.alarm().active
    pack.estimate(soc=0.9, soc_std=0.1)
    assert not pack.alarm().active


@pytest.mark.parametrize(
    ("without_margin", "reason"),
    [({"delta": -0.02}, ALWAYS_STABLE), ({"delta_valid": False}, NOT_IDENTIFIED)],
    ids=["stable at each SOC", "a7..a12 not valid"],
)
@pytest.mark.parametrize("restart", [False, True])
def test_a_pack_without_a_margin_has_no_alarm_of_the_margin(
    without_margin: dict[str, Any], reason: str, restart: bool
) -> None:
    """An alarm that an earlier version raised at such a margin ends, too."""
    pack = Pack()
    pack.estimate(soc=0.04, soc_std=0.02, **without_margin)
    assert pack.evaluator.active == ("soc_low",)
    assert pack.alarm("stability_margin_low").unknown_reason == reason
    assert pack.alarm("stability_margin_low").watched
    pack.estimate(soc=0.04, soc_std=0.02)
    assert pack.alarm("stability_margin_low").active
    if restart:
        pack = Pack(pack.evaluator.saved_state)
    pack.estimate(soc=0.04, soc_std=0.02, **without_margin)
    assert pack.evaluator.active == ("soc_low",)
    assert pack.alarm("stability_margin_low").unknown_reason == reason


def test_alarms_of_a_pack_without_an_soc_have_no_value_yet() -> None:
    pack = Pack()
    pack.estimate(soc=np.nan, soc_std=np.nan)
    assert {alarm.unknown_reason for alarm in pack.evaluator.report()} == {None, NO_VALUE}
    assert pack.alarm("soc_low").unknown_reason == NO_VALUE
