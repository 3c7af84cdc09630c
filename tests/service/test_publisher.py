"""Log lines of the publisher."""

from structlog.testing import capture_logs

from bms_estimator.estimator import Estimator
from bms_estimator.model.cell import load_cell
from bms_estimator.model.clock import Clock
from bms_estimator.model.input_faults import InputFault
from bms_estimator.service.publisher import Publisher
from bms_estimator.settings.pack import Settings
from tests.scripted_source import ScriptedSource


def test_suspected_input_faults_are_logged_when_their_set_changes() -> None:
    now_s, cell = 0.0, load_cell("chen_mora")
    estimator = Estimator(cell, initial_soc=0.5)
    estimator.step(0.0, 0.0, 3.8, temperature_c=25.0)
    clock = Clock(monotonic=lambda: now_s)
    publisher = Publisher(Settings(), cell, estimator, source=ScriptedSource(), sinks=[], clock=clock)
    logged = []
    for temperature_c, suspects in (
        (41.0, InputFault.TEMPERATURE),
        (42.0, InputFault.TEMPERATURE),
        (30.0, 0),
        (30.0, 0),
    ):
        now_s += 2.0
        estimator.record["checks"]["suspects"] = int(suspects)
        estimator.record["filter"]["temperature_c"] = temperature_c
        with capture_logs() as lines:
            publisher.publish()
        logged.append([str(line["suspects"])[:30] for line in lines])
    assert logged == [["['no data at 41 C, the cell fi"], [], ["none"], []]
