"""Fit of a cell model to captures: the open-circuit voltage, and then the resistances."""

from collections.abc import Sequence
from dataclasses import dataclass

from bms_estimator.calibration.automatic.capacity_estimate import CapacityEstimate
from bms_estimator.calibration.automatic.hold_back import Split
from bms_estimator.calibration.automatic.recognition import RecognizedCapture
from bms_estimator.calibration.cleaning.clean_capture import clean_capture
from bms_estimator.calibration.cleaning.start_soc import StartOrigin
from bms_estimator.calibration.cleaning.start_soc import initial_soc as soc_of_first_rest
from bms_estimator.calibration.elements.identification import Identification
from bms_estimator.calibration.elements.identify import identify
from bms_estimator.calibration.ocv.source import ExternalCurve, Recording
from bms_estimator.calibration.ocv_cell import OcvCell, determine_ocv
from bms_estimator.model.cell import CellModel, with_capacity, with_name
from bms_estimator.model.errors import UserError
from bms_estimator.model.progress import Progress


@dataclass(frozen=True)
class FittedModel:
    """Cell model fitted to captures.

    Attributes:
        cell: The cell model.
        ocv: Fit of the open-circuit voltage; None if no capture determines it, so that the given cell's OCV is used.
        identification: Fit of the resistances; None if the resistances of the most similar generic cell are used.
        reason: Reason why the resistances are generic; empty if they were identified.
    """

    cell: CellModel
    ocv: OcvCell | None
    identification: Identification | None
    reason: str

    def initial_soc(self, recognized: RecognizedCapture) -> float:
        """Return the SOC at the first sample of a capture, from the identification or else from the capture's first rest."""
        if recognized.start.origin is StartOrigin.GIVEN:
            return recognized.start.soc
        if self.identification is not None:
            for fit in self.identification.captures:
                if fit.name == recognized.capture.name:
                    return fit.initial_soc
        return soc_of_first_rest(clean_capture(recognized.capture.name, recognized.good, self.cell), self.cell)


@dataclass(frozen=True)
class ModelFitter:
    """Fitter of cell models, with the inputs that the fit without the data held back shares with the fit of all data.

    Attributes:
        initial_cell: Given cell with the capacity. It supplies what the captures do not determine.
        capacity: Capacity of the cell.
        curves: Open-circuit voltages over SOC that were measured otherwise.
        name: Name of the new cell.
    """

    initial_cell: CellModel
    capacity: CapacityEstimate
    curves: Sequence[ExternalCurve]
    name: str

    def fit(self, data: Split, progress: Progress) -> FittedModel:
        """Fit the open-circuit voltage, and then the resistances.

        Args:
            data: Captures of the fit.
            progress: Receives the finished fraction of the fit.

        Raises:
            UserError: A capture cannot be used, or neither OCV nor resistances are determined.
        """
        ocv = self._fit_ocv(data.ocv_captures)
        cell = self.initial_cell if ocv is None else ocv.cell
        if ocv is not None and not self.capacity.from_slow_discharge:  # otherwise the OCV's fit has set its std
            cell = with_capacity(cell, cell.cell.capacity_ah, self.capacity.relative_std)
        if not data.resistance_captures:
            return FittedModel(cell, ocv, None, "no capture has a current above 0.1 C")
        captures = [each.capture for each in data.resistance_captures]
        given_socs = {
            each.capture.name: each.start.soc
            for each in data.resistance_captures
            if each.start.origin is StartOrigin.GIVEN
        }
        try:
            identification = identify(captures, cell, initial_socs=given_socs, progress=progress)
        except UserError as error:
            if ocv is None:
                raise
            reason = str(error).splitlines()[0].partition(";")[0]  # the text after the semicolon is a remedy
            return FittedModel(cell, ocv, None, reason)
        return FittedModel(with_name(identification.cell, self.name), ocv, identification, "")

    def _fit_ocv(self, captures: Sequence[RecognizedCapture]) -> OcvCell | None:
        """Fit the open-circuit voltage; None if nothing determines it."""
        if not captures and not self.curves:
            return None
        return determine_ocv(
            [Recording(each.capture.name, each.capture.rows, each.start) for each in captures],
            self.curves,
            name=self.name,
            capacity_ah=None if self.capacity.from_slow_discharge else self.capacity.capacity_ah,
            series_count=1,
        )
