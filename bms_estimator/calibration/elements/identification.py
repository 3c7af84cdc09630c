"""Result of the identification of a cell from captures."""

from dataclasses import dataclass

from bms_estimator.model.cell import CellModel


@dataclass(frozen=True)
class CaptureFit:
    """Result of the fit for one capture.

    Attributes:
        name: Name of the capture.
        samples: Number of samples in the capture.
        glitches: Number of dropped glitches.
        initial_soc: SOC at the first sample, 0..1.
        temperature_c: Lowest and highest temperature [C]; None without a sensor.
        miscount: Relative error of the counted charge. The SOC of the fit is corrected by it.
        voltage_rms_v: RMS residual of the voltage, weighted by time, at SOC above 0.1 [V].
        score_before: Interval score of replays with the given cell [%]; NaN when the capture is too short.
        score_after: Interval score with the identified cell [%].
        held_back: True if ``score_after`` is of a cell that was fitted without this capture.
    """

    name: str
    samples: int
    glitches: int
    initial_soc: float
    temperature_c: tuple[float, float] | None
    miscount: float
    voltage_rms_v: float
    score_before: float
    score_after: float
    held_back: bool


@dataclass(frozen=True)
class Identification:
    """An identified cell.

    Attributes:
        cell: The cell with its ladder, the elements of two RC pairs, and a corrected OCV if that improves the replays.
        elements: Value and standard error of ``r_s``, ``r_ts`` and ``r_tl`` at 25 C by SOC and name [ohm].
        captures: Fit of each capture, in the order given.
        left_out: Names of captures without excitation.
        ocv_correction_v: RMS of the change of the open-circuit voltage over SOC 0.1..1 [V]; 0 if the given OCV is used.
        score_before: Geometric mean of the captures' interval scores with the given cell [%]; NaN when none has a
            score.
        score_after: Geometric mean of the interval scores with the identified cell [%].
        undetermined_starts: Lines on captures whose SOC at the first sample was not given, and whose first voltage allows a wide
            range of SOC.
    """

    cell: CellModel
    elements: dict[float, dict[str, tuple[float, float]]]
    captures: tuple[CaptureFit, ...]
    left_out: tuple[str, ...]
    ocv_correction_v: float
    score_before: float
    score_after: float
    undetermined_starts: tuple[str, ...] = ()
