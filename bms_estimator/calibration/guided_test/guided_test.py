"""State machine of a guided test: samples in; instruction, warnings and progress out.

The test has no clock of its own: all durations are differences of sample times. After a restart, the samples recorded
before lead to the same state.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

from bms_estimator.calibration.guided_test.averages import Average, Averager
from bms_estimator.calibration.guided_test.plan import Limits, Plan
from bms_estimator.model.arrays import NO_CELLS, CellBlock, SampleBlock
from bms_estimator.model.cell_slots import CellSlots

MIN_LOAD_C_RATE = 0.1
"""Minimum C-rate of a load that determines resistances [1/h]."""


def load_warning(mean: Average, limits: Limits) -> str:
    """Return a warning about the current of a discharge; empty if the current is suitable."""
    if mean.current_a < -limits.rest_a:
        return f"The pack is charged at {-mean.current_a:.2f} A: disconnect the charger, and connect a load."
    if mean.current_a <= limits.rest_a:
        return "No current flows: connect the load."
    if mean.current_a < MIN_LOAD_C_RATE * limits.capacity_ah:
        return f"The load draws only {mean.current_a:.2f} A, too little to measure resistances."
    return ""


def limit_warning(mean: Average, limits: Limits) -> str:
    """Return a warning about a limit of the pack that is exceeded; empty if no limit is."""
    if mean.current_a > limits.max_discharge_a:
        return f"The load draws {mean.current_a:.2f} A, more than {limits.max_discharge_a:.2f} A: reduce it now."
    if mean.temperature_c > limits.max_temperature_c:
        return f"The pack is at {mean.temperature_c:.0f} °C: disconnect charger and load until it is below {limits.max_temperature_c:.0f} °C."
    if mean.current_a < -limits.rest_a and (
        mean.max_cell_v > limits.max_cell_v or mean.voltage_v > limits.max_cell_v * limits.series_count
    ):
        return "The voltage is above the limit of the cells: end the charge now."
    return ""


def empty_warning(mean: Average, limits: Limits) -> str:
    """Return a warning about a load that discharges an empty pack; empty without one."""
    if mean.current_a > limits.rest_a and mean.voltage_v <= limits.cutoff_v:
        return f"The pack is empty ({mean.voltage_v:.2f} V): remove the load now."
    return ""


FULL_MARGIN_V = 0.02
"""Tolerance below the full voltage at the end of a charge, per cell [V]."""
RESTED_FULL_MARGIN_V = 0.03
"""Tolerance below the full voltage for a full pack at rest, per cell [V]. Full charges end up to 30 mV apart."""
CONFIRM_S = 60.0
"""Minimum duration of a rest after which a pack counts as full, or a charge as ended too early [s]."""
EMPTY_MEANS = 2
"""Number of successive means at or below the cut-off after which the pack counts as empty."""
MAX_GAP_S = 60.0
"""Maximum time between two means [s]. The charge in a longer gap is unknown."""
MAX_UNPLANNED_CHARGE = 0.01
"""Maximum charge that may flow in a gap, or against the plan, as a fraction of the capacity."""
RELAY_OPEN_S = 60.0
"""Time for which a relay disconnects the load after a limit was exceeded [s]."""
INTERRUPTION_S = 3.0
"""Duration of a current in a rest after which the rest begins again [s]."""


class Phase(StrEnum):
    """Part of a test."""

    CHARGE = "charge"
    FULL_REST = "rest of the full pack"
    DISCHARGE = "discharge"
    REST = "rest"
    DONE = "done"


@dataclass(frozen=True)
class OcvPoint:
    """Voltage at the end of a rest.

    Attributes:
        soc: SOC from the charge drawn and the rated capacity, 0..1; it may be below 0.
        voltage_v: Voltage at the terminals [V].
    """

    soc: float
    voltage_v: float


class GuidedTest:
    """A guided test in progress.

    Args:
        plan: Plan of the test.
        limits: Limits of the pack.
        relay: True if a relay connects the load (``load_on``), so that the user need not.

    Attributes:
        phase: Present phase.
        points: Voltages at the ends of the rests.
        drawn_ah: Charge drawn since the pack was full [Ah].
        discharge_number: Number of the present or last discharge, from 1; 0 before the first.
        begin_s: Time at which the rest of the full pack began [s]; NaN before. The capture for the calibration begins here.
        restart_reason: Reason why the test began again; empty if it did not, and as soon as the pack is full again.
        warning: Deviation from the instruction, and its remedy; empty if there is no deviation.
        latest: Latest mean; None before the first.
    """

    def __init__(self, plan: Plan, limits: Limits, *, relay: bool = False) -> None:
        self._plan, self._limits, self._relay = plan, limits, relay
        self._slots = CellSlots(limits.series_count)
        self._averager = Averager()
        self._start_again("")
        self.latest: Average | None = None
        self._blocked_until_s = -math.inf

    def feed(self, samples: SampleBlock, cells_v: CellBlock = NO_CELLS) -> None:
        """Advance the test.

        Args:
            samples: Samples of the pack, whose time continues over restarts.
            cells_v: Voltages of the device's cell slots; empty if unknown.
        """
        selected_v = self._slots.select(cells_v)
        # with more live slots than cells in series, the lowest of all slots may end the discharge
        for average in self._averager.feed(samples, cells_v if self._slots.fault else selected_v):
            self._advance(average)

    @property
    def is_done(self) -> bool:
        """True after the last rest."""
        return self.phase is Phase.DONE

    @property
    def instruction(self) -> str:
        """Instruction for the user, as a sentence."""
        if self.phase is Phase.CHARGE:
            return f"Charge the pack to full ({self._limits.full_v:.2f} V), and wait until the charger ends."
        if self.phase is Phase.DONE:
            return "Done: remove the load, and charge the pack."
        if self.phase is Phase.REST and self._relay:
            return "The pack rests: nothing to do."
        if self.phase is not Phase.DISCHARGE:
            return f"Let the pack rest: disconnect {'the charger' if self._relay else 'charger and load'}."
        if self._relay:
            return f"The relay discharges the pack, and stops at {self._limits.cutoff_v:.2f} V: nothing to do."
        return (
            f"Discharge the pack at about {self.load_a:.2g} A, at most {self._limits.max_discharge_a:.2g} A; "
            f"stop at {self._limits.cutoff_v:.2f} V."
        )

    @property
    def load_a(self) -> float:
        """Current of the discharges [A]."""
        return min(self._plan.load_c_rate * self._limits.capacity_ah, self._limits.max_discharge_a)

    @property
    def load_on(self) -> bool:
        """True if a relay must connect the load."""
        return self.phase is Phase.DISCHARGE and self.latest is not None and self.latest.time_s >= self._blocked_until_s

    @property
    def progress(self) -> float:
        """Fraction of the time after the charge that has passed, 0..1."""
        return max(0.0, 1.0 - self.remaining_s / self._total_s)

    @property
    def remaining_s(self) -> float:
        """Estimated time until the end, without the charge [s]."""
        if self.phase is Phase.CHARGE:
            return self._total_s
        rest_s = self._remaining_rest_s if self.phase in (Phase.FULL_REST, Phase.REST) else 0.0
        return rest_s if self._is_empty else rest_s + self._discharges_s(self.drawn_ah)

    @property
    def remaining_basis(self) -> str:
        """Basis of the remaining time, such as the rated capacity and the measured current."""
        current = f"the measured {self._mean_load_a:.2f} A" if self._load_h else f"a load of {self.load_a:.2g} A"
        without = ", without the charge" if self.phase is Phase.CHARGE else ""
        return f"from the rated {self._limits.capacity_ah:g} Ah and {current}{without}"

    @property
    def expected_discharges(self) -> int:
        """Expected number of discharges, by the rated capacity."""
        return max(round(1.0 / self._plan.step_soc) + 1, self.discharge_number)

    @property
    def _total_s(self) -> float:
        return self._plan.full_rest_s + self._discharges_s(0.0)

    @property
    def _remaining_rest_s(self) -> float:
        goal_s = self._plan.full_rest_s if self.phase is Phase.FULL_REST else self._plan.rest_s
        return max(goal_s - self._rested_s, 0.0)

    @property
    def _mean_load_a(self) -> float:
        """Mean current of the discharges [A]."""
        return self._load_ah / self._load_h if self._load_h else self.load_a

    def _discharges_s(self, drawn_ah: float) -> float:
        """Return the time of the remaining discharges and the rests after them [s]."""
        remaining_ah = max(self._limits.capacity_ah - drawn_ah, 0.0)
        rests = self._plan.remaining_rests(drawn_ah / self._limits.capacity_ah)
        return 3600.0 * remaining_ah / self._mean_load_a + rests * self._plan.rest_s

    def _start_again(self, reason: str) -> None:
        """Begin with the charge."""
        self.phase, self.warning, self.restart_reason = Phase.CHARGE, "", reason
        self.points: list[OcvPoint] = []
        self.begin_s = math.nan
        self._reached_full = self._was_charged = self._is_empty = False
        self.discharge_number = 0
        self._low_means = 0  # successive means at or below the cut-off
        self.drawn_ah = 0.0
        self._step_ah = 0.0  # charge drawn in this discharge
        self._returned_ah = 0.0  # charge into the pack during discharges and rests
        self._load_ah = self._load_h = 0.0  # charge and duration of all discharges
        self._idle_s = 0.0  # time without a current before the rest of the full pack
        self._rested_s = 0.0  # time without a current in this rest
        self._interrupted_s = 0.0  # duration of the present current in this rest

    @property
    def _max_unplanned_ah(self) -> float:
        return MAX_UNPLANNED_CHARGE * self._limits.capacity_ah

    def _advance(self, mean: Average) -> None:
        """Advance the test by a mean; begin again if too much charge may have flowed in a gap before it."""
        step_s = 0.0 if self.latest is None else mean.time_s - self.latest.time_s
        last_a = 0.0 if self.latest is None else self.latest.current_a
        self.latest = mean
        lost_ah = abs(last_a) * step_s / 3600.0 if step_s > MAX_GAP_S else 0.0
        if lost_ah > self._max_unplanned_ah and self.phase is not Phase.CHARGE:
            self._start_again(f"Up to {lost_ah:.2f} Ah flowed while nothing was measured; begin again.")
            return
        self.warning = ""
        if self.phase is not Phase.CHARGE:
            self._count(mean, step_s)
        if self.phase is Phase.CHARGE:
            self._advance_charge(mean, step_s)
        elif self.phase is Phase.DISCHARGE:
            self._advance_discharge(mean, step_s)
        elif self.phase is not Phase.DONE:
            self._advance_rest(mean, step_s)
        if warning := limit_warning(mean, self._limits):
            self.warning, self._blocked_until_s = warning, mean.time_s + RELAY_OPEN_S
        elif self.phase is not Phase.DISCHARGE:  # a discharge ends by itself at the cut-off
            self.warning = empty_warning(mean, self._limits) or self.warning

    def _count(self, mean: Average, step_s: float) -> None:
        """Count the charge drawn since the pack was full. Begin again if the pack is charged, or discharged too early."""
        self.drawn_ah += mean.current_a * step_s / 3600.0
        if self.phase in (Phase.DISCHARGE, Phase.REST):
            self._returned_ah += max(-mean.current_a - self._limits.rest_a, 0.0) * step_s / 3600.0
        if self._returned_ah > self._max_unplanned_ah:
            self._start_again("The pack was charged during the test; begin again.")
        elif self.phase is Phase.FULL_REST and self.drawn_ah > self._max_unplanned_ah:
            self._start_again("The pack was discharged before the rest of the full pack ended; begin again.")

    def _advance_charge(self, mean: Average, step_s: float) -> None:
        """Wait until the pack is full."""
        cells, full_v = self._limits.series_count, self._limits.full_v
        if mean.current_a < -self._limits.rest_a:
            self._was_charged = True
        self._reached_full |= self._was_charged and mean.voltage_v >= full_v - FULL_MARGIN_V * cells
        if self._reached_full and abs(mean.current_a) <= max(self._limits.tail_a, self._limits.rest_a):
            self._enter(Phase.FULL_REST, mean)
            return
        is_resting = abs(mean.current_a) <= self._limits.rest_a
        self._idle_s = self._idle_s + step_s if is_resting else 0.0
        if self._idle_s >= CONFIRM_S:
            if mean.voltage_v >= full_v - RESTED_FULL_MARGIN_V * cells:
                self._enter(Phase.FULL_REST, mean)
            elif self._was_charged:
                self.warning = (
                    f"The charge ended at {mean.voltage_v:.2f} V, below {full_v:.2f} V: charge further, or set "
                    "pack.full_voltage_v to the voltage at which your charger ends."
                )
        elif mean.current_a > self._limits.rest_a:
            self.warning = (
                f"The pack is discharged at {mean.current_a:.2f} A: remove the load, and connect the charger."
            )

    def _advance_rest(self, mean: Average, step_s: float) -> None:
        """Wait until the rest is over. A current begins the rest again."""
        if abs(mean.current_a) > self._limits.rest_a:
            self._interrupted_s += step_s
            verb = "discharged" if mean.current_a > 0.0 else "charged"
            self.warning = f"The pack is {verb} at {abs(mean.current_a):.2f} A: disconnect it; the rest begins again."
            if self._interrupted_s > INTERRUPTION_S:
                self._rested_s = 0.0
                if self.phase is Phase.FULL_REST and mean.current_a < 0.0:  # a full pack that is charged stays full
                    self.begin_s, self.drawn_ah = mean.time_s, 0.0
            return
        self._interrupted_s = 0.0
        self._rested_s += step_s
        if self._remaining_rest_s > 0.0:
            return
        self.points.append(OcvPoint(1.0 - self.drawn_ah / self._limits.capacity_ah, mean.voltage_v))
        self._enter(Phase.DONE if self._is_empty else Phase.DISCHARGE, mean)

    def _advance_discharge(self, mean: Average, step_s: float) -> None:
        """Wait until the charge of a step is drawn, or the pack is empty."""
        if mean.current_a > self._limits.rest_a:
            self._step_ah += mean.current_a * step_s / 3600.0
            self._load_ah += mean.current_a * step_s / 3600.0
            self._load_h += step_s / 3600.0
        self.warning = load_warning(mean, self._limits)
        is_low = mean.voltage_v <= self._limits.cutoff_v or mean.min_cell_v <= self._limits.min_cell_v
        self._low_means = self._low_means + 1 if is_low else 0
        self._is_empty = self._low_means >= EMPTY_MEANS
        goal_ah = self._plan.discharge_soc(self.discharge_number) * self._limits.capacity_ah
        if self._is_empty or self._step_ah >= goal_ah:
            self._enter(Phase.REST, mean)

    def _enter(self, phase: Phase, mean: Average) -> None:
        self.phase = phase
        self._rested_s = self._interrupted_s = self._step_ah = 0.0
        self._low_means = 0
        if phase is Phase.FULL_REST:
            self.begin_s, self.drawn_ah, self.restart_reason = mean.time_s, 0.0, ""
        self.discharge_number += phase is Phase.DISCHARGE
