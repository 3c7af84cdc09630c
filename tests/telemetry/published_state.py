"""Payload of the topic ``state`` of an estimator."""

from bms_estimator.estimator import Estimator
from bms_estimator.estimator.estimator import TraceBlock
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.telemetry.lifetime_totals import ChargeEnergy
from bms_estimator.telemetry.publish_window import Window
from bms_estimator.telemetry.state import make_state_payload, no_forecast
from bms_estimator.telemetry.weakest_cell import remaining_capacity_ah


def published_state(estimator: Estimator, trace: TraceBlock) -> Estimate:
    """Return the state that is published after a block whose estimates are ``trace``, the only one of the run."""
    window = Window()
    window.add(trace, 0.0)
    summary = window.take()
    assert summary is not None
    left_ah = remaining_capacity_ah(estimator)
    return make_state_payload(summary, left_ah, no_forecast("none"), {}, 0.0, ChargeEnergy(), None)
