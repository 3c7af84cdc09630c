"""Faults of the input that the identifier detects, and their remedies."""

from enum import IntFlag


class InputFault(IntFlag):
    """Bits of ``suspects`` of ``kernels.kalman_filter.input_checks.CHECKS``; several may be set."""

    SIGN_OF_CURRENT = 1
    OFFSET = 2
    CAPACITY = 4
    OCV = 8
    OUTLIERS = 16
    TEMPERATURE = 32
    VOLTAGE = 64
    CURRENT = 128
    PACK = 256
    LEVEL = 512
    FITTED_CURVE = 1024
    FITTED_RESISTANCE = 2048
    FITTED_TEMPERATURE = 4096

    @property
    def text(self) -> str:
        """Description and remedy of every set bit."""
        return "; ".join(_TEXTS[suspect] for suspect in InputFault if suspect in self)


_TEXTS = {
    InputFault.SIGN_OF_CURRENT: "the voltage rises when the reported discharge current rises: "
    "check the sign of the current (sensor.current_sign; --current-sign of a recording)",
    InputFault.OFFSET: "counted charge and voltage drift apart with time: "
    "check the zero of the current sensor with the load disconnected",
    InputFault.CAPACITY: "counted charge and voltage drift apart with charge moved: check the declared capacity, "
    "the cell may have aged",
    InputFault.OCV: "no plausible OCV fits voltage and SOC: check that the OCV curve belongs to this cell's chemistry "
    "and the number of cells in series",
    InputFault.OUTLIERS: "single samples deviate strongly from their neighbors: check wiring and supply of the sensors, "
    "and that voltage and current are taken at the same time",
    InputFault.TEMPERATURE: "errors are larger there: check the temperature sensor, or make the cell file with captures "
    "at this temperature",
    InputFault.VOLTAGE: "the voltage is constant to the last digit although current or charge must change it: check its wire, "
    "and that the source does not repeat an old value",
    InputFault.CURRENT: "the current is constant to the last digit although the voltage changes: check the current sensor, "
    "and that all loads flow through it",
    InputFault.LEVEL: "the voltage of the plateau lies farther from the OCV curve than in cells of this chemistry: check the "
    "voltage of the terminals with a multimeter; if it differs, correct the voltage of the source, or else make a cell file with "
    "the curve of this cell (bms-estimator ocv)",
    InputFault.PACK: "SOC or voltages after a gap do not fit the pack before it: check whether the pack was exchanged, because "
    "capacity and resistances were learned from the earlier pack; the request forget_pack discards them",
    InputFault.FITTED_CURVE: "fitted OCV or hysteresis lie far from those of the cell file: check the chemistry of the cell "
    "and the voltage of the terminals with a multimeter, or make a cell file with the curve of this cell (bms-estimator ocv)",
    InputFault.FITTED_RESISTANCE: "fitted resistances lie far from those of the cell file: check contacts, the place of the "
    "voltage taps, the number of cells in parallel, and that voltage and current are taken at the same time",
    InputFault.FITTED_TEMPERATURE: "the fitted change of OCV or resistances with temperature lies far from that of the cell "
    "file: check that the temperature sensor touches the cells, or make a cell file with captures at several temperatures",
}
