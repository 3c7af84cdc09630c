"""One measurement in the export format of each cycler, library and public data set: preamble, columns, units, signs."""

import gzip
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
START = datetime(2024, 3, 12, 23, 59, 30)  # noqa: DTZ001 - cyclers write local time
"""Start of the measurement, half a minute before midnight."""


@dataclass(frozen=True)
class Measurement:
    """A rest, a discharge, a rest and a charge, with one row per second and step."""

    time_s: Floats
    current_a: Floats
    """Positive on discharge."""
    voltage_v: Floats
    temperature_c: Floats
    step: NDArray[np.int64]

    @property
    def charge_a(self) -> Floats:
        """Current, positive on charge [A]."""
        return -self.current_a

    @property
    def zeros(self) -> NDArray[np.int64]:
        """Column of zeros, for quantities that the reader does not use."""
        return np.zeros_like(self.step)

    @property
    def ones(self) -> NDArray[np.int64]:
        """Column of ones, for quantities that the reader does not use."""
        return np.ones_like(self.step)

    def states(self, discharge: str, charge: str, rest: str) -> list[str]:
        """Return the name of the state of each row."""
        return [discharge if current > 0 else charge if current < 0 else rest for current in self.current_a]


def measure() -> Measurement:
    """Return the measurement that all exports contain, with rounded values."""
    step = np.repeat(np.arange(4), 21)
    time_s = np.arange(step.size) - step  # the last row of a step and the first of the next have the same time
    current_a = np.array([0.0, 1.5, 0.0, -0.75])[step]
    drawn_as = np.cumsum(current_a)
    voltage_v = np.round(3.9 - 0.001 * drawn_as - 0.04 * current_a, 4)
    return Measurement(time_s.astype(np.float64), current_a, voltage_v, 25.0 + 0.1 * step, step)


def text(rows: Iterable[Sequence[object]], separator: str = ",") -> str:
    """Return rows as delimited text."""
    return "".join(separator.join(str(cell) for cell in row) + "\n" for row in rows)


def stamps(m: Measurement, time_format: str) -> list[str]:
    """Return the date and time of each row."""
    return [(START + timedelta(seconds=second)).strftime(time_format) for second in m.time_s]


def durations(m: Measurement) -> list[str]:
    """Return the time since the start as h:m:s."""
    return [f"{int(s) // 3600:02d}:{int(s) // 60 % 60:02d}:{s % 60:06.3f}" for s in m.time_s]


def arbin(m: Measurement) -> str:
    """Return a CSV of MITS Pro."""
    header = "Data Point,Date Time,Test Time (s),Step Time (s),Cycle Index,Step Index,Current (A),Voltage (V),Charge Capacity (Ah),Discharge Capacity (Ah),Aux_Temperature_1 (C)"
    rows = zip(
        range(1, m.step.size + 1), stamps(m, "%m/%d/%Y %H:%M:%S.%f"), m.time_s, m.time_s, m.ones,
        m.step + 1, m.charge_a, m.voltage_v, m.zeros, m.zeros, m.temperature_c, strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def neware_layer(m: Measurement) -> str:
    """Return a CSV of BTSDA with its flat columns."""
    header = "DataPoint,Cycle Index,Step Index,Step Type,Time,Total Time,Current(A),Voltage(V),Capacity(Ah),Chg. Cap.(Ah),DChg. Cap.(Ah),Date,Power(W)"
    rows = zip(
        range(1, m.step.size + 1), m.ones, m.step + 1, m.states("CC DChg", "CC Chg", "Rest"),
        ["00:00:01.000"] * m.step.size, durations(m), m.charge_a, m.voltage_v, m.zeros, m.zeros, m.zeros,
        stamps(m, "%Y-%m-%d %H:%M:%S"), m.zeros, strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def neware_layered(m: Measurement) -> str:
    """Return a CSV of BTSDA with a layer for cycles, one for steps and one for records."""
    lines = [
        "Cycle Index,Chg. Cap.(Ah),DChg. Cap.(Ah)",
        ",Step Index,Step Number,Step Type,Step Time,Capacity(Ah)",
        ",,DataPoint,Time,Total Time,Current(A),Voltage(V),Date",
        "1,0.004,0.008,1465,0.10,1.34,00:01:20,00:00:20",
    ]
    states = m.states("CC DChg", "CC Chg", "Rest")
    rows = zip(durations(m), durations(m), m.charge_a, m.voltage_v, stamps(m, "%Y-%m-%d %H:%M:%S"), strict=True)
    for number, row in enumerate(rows):
        if number == 0 or m.step[number] != m.step[number - 1]:
            lines.append(f",{m.step[number] + 1},{m.step[number] + 1},{states[number]},00:00:20,0.001")
        lines.append(f",,{number + 1}," + ",".join(map(str, row)))
    return "\n".join(lines) + "\n"


def neware_unsigned(m: Measurement) -> str:
    """Return a CSV of an older BTSDA: unsigned current in mA, state, date, encoded in GBK."""
    header = "Record number,State,Jump,Cycle,Steps,Current(mA),Voltage(V),Capacity(mAh),Energy(mWh),Relative Time(h:min:s.ms),Date(h:min:s.ms)"
    rows = zip(
        range(1, m.step.size + 1), m.states("CC_DChg", "CCCV_Chg", "Rest"), m.step, m.ones, m.step + 1,
        np.abs(1e3 * m.current_a), m.voltage_v, m.zeros, m.zeros, durations(m),
        stamps(m, "%Y-%m-%d %H:%M:%S"), strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def neware_record(m: Measurement) -> str:
    """Return a CSV of BTSDA with absolute times and the abbreviations Cur and Vol."""
    header = "Record ID,Step Name,Relative Time(h:min:s.ms),Realtime,Cur(mA),Voltage(mV),Temperature(¡æ)"
    rows = zip(
        range(1, m.step.size + 1), m.states("CC_DChg", "CC_Chg", "Rest"), durations(m),
        stamps(m, "%Y-%m-%d %H:%M:%S"), 1e3 * m.charge_a, 1e3 * m.voltage_v, m.temperature_c, strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def maccor(m: Measurement) -> str:
    """Return a text of MIMS client: unsigned current, state, durations with days."""
    preamble = "Today's Date\t03/14/2024\tDate of Test:\t03/12/2024\tFilename:\tC:\\cell.001\tProcedure:\tcycle.000\tComment/Barcode:\tnone\n\n"
    header = "Rec\tCycle P\tCycle C\tStep\tTestTime\tStepTime\tCap. [Ah]\tEner. [Wh]\tCurrent [A]\tVoltage [V]\tMd\tES\tDPT Time\n"
    days = [f"  0d {duration[:-1]}" for duration in durations(m)]
    rows = zip(
        range(1, m.step.size + 1), m.zeros, m.zeros, m.step + 1, days, days, m.zeros, m.zeros,
        np.abs(m.current_a), m.voltage_v, m.states("D", "C", "R"), m.ones,
        stamps(m, "%m/%d/%Y %I:%M:%S %p"), strict=True,
    )  # fmt: skip
    return preamble + header + text(rows, "\t")


def maccor_seconds(m: Measurement) -> str:
    """Return a text of an older Maccor: seconds, Amps and Volts without brackets, grouped digits."""
    preamble = "Today's Date 03/14/2024\tDate of Test:\t03/12/2024\tFilename:\tC:\\cell.001\n"
    header = "Rec#\tCyc#\tStep\tTest (Sec)\tStep (Sec)\tAmp-hr\tWatt-hr\tAmps\tVolts\tState\tES\n"
    rows = zip(
        [f"{1000 + i:,}" for i in range(m.step.size)], m.zeros, m.step + 1, m.time_s, m.time_s, m.zeros,
        m.zeros, np.abs(m.current_a), m.voltage_v, m.states("D", "C", "R"), m.ones, strict=True,
    )  # fmt: skip
    return preamble + header + text(rows, "\t")


def biologic(m: Measurement) -> str:
    """Return a text of EC-Lab, with its preamble."""
    preamble = [
        "EC-Lab ASCII FILE",
        "Nb header lines : 6",
        "",
        "Modulo Bat",
        "Acquisition started on : 03/12/2024 23:59:30",
    ]
    header = "mode\tox/red\terror\tNs changes\tNs\ttime/s\tcontrol/V/mA\tEwe/V\t<I>/mA\tcycle number\tTemperature/°C"
    rows = zip(
        m.ones, (m.current_a < 0).astype(int), m.zeros, m.zeros, m.step,
        [f"{time:.15E}" for time in m.time_s], [f"{1e3 * current:.7E}" for current in m.charge_a],
        [f"{voltage:.7E}" for voltage in m.voltage_v], [f"{1e3 * current:.7E}" for current in m.charge_a],
        m.zeros, m.temperature_c, strict=True,
    )  # fmt: skip
    return "\n".join([*preamble, header]) + "\n" + text(rows, "\t")


def biologic_decimal_comma(m: Measurement) -> str:
    """Return a text of EC-Lab on a computer with decimal commas."""
    head, separator, rows = biologic(m).partition("Temperature/°C\n")
    return head + separator + rows.replace(".", ",")


def digatron(m: Measurement) -> str:
    """Return a CSV of Battery Manager: units after #; ``Program Duration#s`` is in milliseconds, as in some genuine files."""
    header = "Step,Cycle,Status,Timestamp,Program Duration#s,Voltage#V,Current#A,T1#degC,AhCha#AH,AhDch#Ah"
    times = [f"{stamp}+00:00" for stamp in stamps(m, "%Y-%m-%d %H:%M:%S")]
    rows = zip(
        m.step + 1, m.ones, m.states("DCH", "CHA", "PAU"), times, 1e3 * m.time_s, m.voltage_v, m.charge_a,
        m.temperature_c, m.zeros, m.zeros, strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def lg_hg2(m: Measurement) -> str:
    """Return a CSV of the LG HG2 data set: Digatron with a row of units, whose cells are empty for times and words."""
    preamble = "\nMeasurement ID,551\nBattery Name,LG HG2\nStart Time,3/12/2024 11:59:30 PM\n"
    header = "Time Stamp,Step,Status,Prog Time,Step Time,Cycle,Cycle Level,Procedure,Voltage,Current,Temperature,Capacity,WhAccu,Cnt,\n"
    units = ",,,,,,,,[V],[A],[C],[Ah],[Wh],[Cnt],\n"
    rows = zip(
        stamps(m, "%m/%d/%Y %I:%M:%S %p"), m.step, m.states("DCH", "CHA", "PAU"), durations(m), durations(m), m.zeros,
        m.zeros, ["HPPC"] * m.step.size, m.voltage_v, m.charge_a, m.temperature_c, m.zeros, m.zeros, m.zeros,
        [""] * m.step.size, strict=True,
    )  # fmt: skip
    return preamble + header + units + text(rows)


def novonix(m: Measurement) -> str:
    """Return a CSV of a Novonix charger, with each line in quotes."""
    lines = ["[Summary]", "Novonix HPC data file", "Capacity (Ah): 3.2", "[End Summary]", "[Data]"]
    header = "Date and Time,Cycle Number,Step Number,Run Time (h), Step Time (h),Current (A),Potential (V),Capacity (Ah),Temperature (°C)"
    rows = zip(
        stamps(m, "%m/%d/%Y %I:%M:%S %p"), m.ones, m.step, m.time_s / 3600.0, m.time_s / 3600.0, m.charge_a, m.voltage_v,
        m.zeros, m.temperature_c, strict=True,
    )  # fmt: skip
    return "".join(f'"{line}"\n' for line in [*lines, header, *text(rows).splitlines()])


def leaf_spy(m: Measurement) -> str:
    """Return a log of LeafSpy."""
    header = "Date/Time,Lat,Long,SOC,Pack Volts,Pack Amps,Judgment Value\n"
    rows = zip(
        stamps(m, "%m/%d/%Y %H:%M:%S"), m.zeros, m.zeros, m.zeros, m.voltage_v, m.current_a, m.zeros, strict=True
    )  # fmt: skip
    return header + text(rows)


def pybamm(m: Measurement) -> str:
    """Return a CSV of ``solution.save_data`` with the default variables of an older version."""
    header = "Time [s],Current [A],Terminal voltage [V],Discharge capacity [A.h],Volume-averaged cell temperature [K]"
    rows = zip(m.time_s, m.current_a, m.voltage_v, m.zeros, m.temperature_c + 273.15, strict=True)
    return header + "\n" + text(rows)


def pybop(m: Measurement) -> str:
    """Return a CSV of a PyBOP dataset."""
    return "Time [s],Current function [A],Voltage [V]\n" + text(zip(m.time_s, m.current_a, m.voltage_v, strict=True))


def nasa(m: Measurement) -> str:
    """Return a CSV of the NASA battery data set."""
    header = "Voltage_measured,Current_measured,Temperature_measured,Current_load,Voltage_load,Time"
    rows = zip(
        m.voltage_v, m.charge_a, m.temperature_c, np.abs(m.current_a), m.voltage_v, m.time_s, strict=True
    )  # fmt: skip
    return header + "\n" + text(rows)


def bdf_labels(m: Measurement) -> str:
    """Return a CSV of the Battery Data Format with spelled-out columns."""
    header = "Test Time / s,Voltage / V,Current / A,Surface Temperature / degC"
    return header + "\n" + text(zip(m.time_s, m.voltage_v, m.charge_a, m.temperature_c, strict=True))


def bdf_names(m: Measurement) -> str:
    """Return a CSV of the Battery Data Format with machine-readable columns."""
    header = "test_time_second,voltage_volt,current_ampere,ambient_temperature_celsius"
    return header + "\n" + text(zip(m.time_s, m.voltage_v, m.charge_a, m.temperature_c, strict=True))


def battery_archive(m: Measurement) -> str:
    """Return a CSV of batteryarchive.org."""
    header = "Date_Time,Test_Time (s),Cycle_Index,Current (A),Voltage (V),Charge_Capacity (Ah),Discharge_Capacity (Ah),Environment_Temperature (C),Cell_Temperature (C)"
    rows = zip(
        stamps(m, "%Y-%m-%d %H:%M:%S.%f"), m.time_s, m.ones, m.charge_a, m.voltage_v, m.zeros, m.zeros,
        20 + m.zeros, m.temperature_c, strict=True,
    )  # fmt: skip
    return header + "\n" + text(rows)


def unsigned(m: Measurement) -> str:
    """Return a CSV of a hobby tester, which writes the magnitude of the current below a table of steps."""
    preamble = "*Step,Mode,Capacity,Energy\n*1-1,D-CC,0.008,0.03\n*1-2,C-CV,0.004,0.02\n"
    rows = zip(m.time_s, np.abs(m.current_a), m.voltage_v, strict=True)
    return preamble + "Time(S),Cur(A),Vol(V)\n" + text(rows)


def german(m: Measurement) -> str:
    """Return a CSV with German columns, semicolons, decimal commas and a row of units."""
    rows = zip(m.time_s / 60.0, 1e3 * m.charge_a, 1e3 * m.voltage_v, m.temperature_c, strict=True)
    return "Zeit;Strom;Spannung;Temperatur\nmin;mA;mV;°C\n" + text(rows, ";").replace(".", ",")


def separate_currents(m: Measurement) -> str:
    """Return a table with one column for the charge current and one for the discharge current."""
    discharge_a, charge_a = m.current_a.clip(min=0.0), m.charge_a.clip(min=0.0)
    header = "Elapsed Time [h]\tDischarge Current [A]\tCharge Current [A]\tVoltage [V]"
    return header + "\n" + text(zip(m.time_s / 3600.0, discharge_a, charge_a, m.voltage_v, strict=True), "\t")


@dataclass(frozen=True)
class Export:
    """Format of an export.

    Attributes:
        write: Function that returns its text.
        dialect: Name that the reader gives it.
        suffix: Usual extension of its files.
        encoding: Encoding of its text.
        has_temperature: True if it contains the temperature.
        reader: Name of the reader of ionworksdata; None if it does not read the format.
    """

    write: Callable[[Measurement], str]
    dialect: str
    suffix: str = ".csv"
    encoding: str = "utf-8"
    has_temperature: bool = True
    reader: str | None = None

    def save(self, folder: Path) -> Path:
        """Write the export, and return its path."""
        path = folder / f"{self.write.__name__}{self.suffix}"
        path.write_bytes(self.write(measure()).encode(self.encoding))
        return path


EXPORTS = (
    Export(arbin, "Arbin", reader="arbin"),
    Export(neware_layer, "Neware", has_temperature=False, reader="neware"),
    Export(neware_layered, "Neware", has_temperature=False),
    Export(neware_unsigned, "Neware", has_temperature=False),
    Export(neware_record, "Neware", encoding="latin-1"),
    Export(maccor, "Maccor", ".txt", has_temperature=False, reader="maccor"),
    Export(maccor_seconds, "Maccor", ".txt", has_temperature=False, reader="maccor"),
    Export(biologic, "BioLogic", ".mpt", "latin-1", reader="biologic mpt"),
    Export(biologic_decimal_comma, "BioLogic", ".mpt", "latin-1", reader="biologic mpt"),
    Export(digatron, "Digatron", reader="digatron"),
    Export(lg_hg2, "unknown program"),
    Export(novonix, "Novonix"),
    Export(leaf_spy, "unknown program", has_temperature=False),
    Export(pybamm, "PyBaMM"),
    Export(pybop, "PyBaMM or PyBOP", has_temperature=False),
    Export(nasa, "NASA"),
    Export(bdf_labels, "Battery Data Format"),
    Export(bdf_names, "Battery Data Format", reader="bdf"),
    Export(battery_archive, "Battery Archive"),
    Export(unsigned, "unknown program", has_temperature=False),
    Export(german, "unknown program", encoding="latin-1"),
    Export(separate_currents, "unknown program", has_temperature=False),
)
"""Exports in text."""


def compressed(path: Path, suffix: str) -> Path:
    """Write a compressed copy of a file, ``.gz`` or ``.zip``, and return its path."""
    packed = path.with_name(path.name + suffix)
    if suffix == ".gz":
        packed.write_bytes(gzip.compress(path.read_bytes()))
    else:
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(path, path.name)
    return packed
