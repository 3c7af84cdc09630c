"""Dialects: column names and sign conventions of cyclers, libraries and public data sets.

Names are compared by ``cell_values.fold`` and without their unit, so that ``Test_Time(s)``, ``Test Time (s)`` and ``TestTime``
are the same name.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from bms_estimator.model.arrays import CurrentSign
from bms_estimator.sources.captures.tables.cell_values import ColumnName, fold


@dataclass(frozen=True)
class Dialect:
    """Column names of a program. If a table has several columns of a quantity, the name that is listed first is used."""

    name: str
    time: tuple[str, ...]
    current: tuple[str, ...]
    voltage: tuple[str, ...]
    temperature: tuple[str, ...] = ()
    state: tuple[str, ...] = ()
    """Columns with words for charge and discharge, which give the current its sign."""
    charge_current: tuple[str, ...] = ()
    """Columns of the charge current, if ``current`` contains only the discharge current."""
    instance: tuple[str, ...] = ()
    """Columns with the number or name of the battery, if a table may have rows of several batteries."""
    series: tuple[str, ...] = ()
    """Columns with the number of cells in series."""
    signatures: tuple[tuple[str, ...], ...] = ((),)
    """Sets of column names, with or without their units. A table that has all names of a set has this dialect."""
    time_unit: str | None = None
    """Unit of the time if the column states none; None: not defined by the format."""
    current_sign: CurrentSign | None = None
    """Direction of positive current; None: not defined by the format."""

    def matches(self, header: Sequence[str], names: Sequence[ColumnName]) -> bool:
        """Return True if a header has all columns of one of the signatures."""
        present = {cell.strip().lower() for cell in header} | {column.name for column in names}
        return any(
            all(column.lower() in present or fold(column) in present for column in signature)
            for signature in self.signatures
        )


DISCHARGE_CURRENTS = ("discharge current", "discharging current", "battery discharge current", "entladestrom")
"""Names of a column that contains only the discharge current. The charge current has another column."""

CLOCKS = (
    "absolute time",
    "date time",
    "realtime",
    "date",
    "dpt time",
    "time stamp",
    "unix time",
    "date and time",
    "prog time",
)
"""Names of a second time column, which does not restart at a step of the test."""

OWN = Dialect(
    "bms_estimator",
    time=("time",),
    current=("current",),
    voltage=("voltage",),
    temperature=("temperature",),
    signatures=(("time_s", "current_a", "voltage_v"),),
)
"""Columns of this project: ``time_s``, ``current_a``, ``voltage_v`` and ``temperature_c``."""

GENERIC = Dialect(
    "unknown program",
    time=(
        "test time",
        "total time",
        "elapsed time",
        "run time",
        "gesamtzeit",
        "testzeit",
        "总时间",
        "测试时间",
        "time",
        "t",
        "zeit",
        "temps",
        "tiempo",
        "tempo",
        "时间",
        "timestamp",
        "unix timestamp",
        "zeitstempel",
        "date time",
        "absolute time",
        "date and time",
        "date",
        "datum zeit",
        "datum",
        "绝对时间",
        "系统时间",
    ),
    current=(
        "battery current",
        "pack current",
        "current",
        "i",
        "<i>",
        "cur",
        "amps",
        "pack amps",
        "strom",
        "courant",
        "corriente",
        "corrente",
        "电流",
        "im",
        *DISCHARGE_CURRENTS,
    ),
    voltage=(
        "battery voltage",
        "pack voltage",
        "voltage",
        "terminal voltage",
        "u",
        "v",
        "e",
        "vol",
        "volt",
        "volts",
        "pack volts",
        "potential",
        "spannung",
        "tension",
        "tensión",
        "voltaje",
        "tensione",
        "电压",
        "vf",
    ),
    temperature=(
        "temperature",
        "cell temperature",
        "temp",
        "t cell",
        "temperatur",
        "température",
        "temperatura",
        "温度",
    ),
    state=("state", "status", "mode", "step type", "zustand", "schrittart", "工步类型", "状态"),
    charge_current=("charge current", "charging current", "battery charge current", "ladestrom"),
    instance=(
        "device",
        "device id",
        "device name",
        "bms",
        "bms id",
        "battery id",
        "battery name",
        "battery no",
        "pack id",
        "pack name",
        "pack no",
        "serial number",
        "mac",
        "host",
    ),
)
"""Common names. This dialect is tried last."""

DIALECTS = (
    OWN,
    Dialect(
        "Battery Data Format",
        time=("test time",),
        current=("current",),
        voltage=("voltage",),
        temperature=("surface temperature", "temperature t1", "surface temperature t1", "ambient temperature"),
        signatures=(
            ("Test Time / s", "Current / A", "Voltage / V"),
            ("test_time_second", "current_ampere", "voltage_volt"),
        ),
        current_sign="charge_positive",
    ),
    Dialect(
        "Battery Archive",
        time=("test time",),
        current=("current",),
        voltage=("voltage",),
        temperature=("cell temperature", "environment temperature"),
        signatures=(
            ("test time", "cell temperature", "cycle index"),
            ("test time", "environment temperature", "cycle index"),
        ),
        current_sign="charge_positive",
    ),
    Dialect(
        "Neware",
        time=("total time", "absolute time", "date", "date time", "realtime"),
        current=("current", "cur"),
        voltage=("voltage", "volt", "vol"),
        temperature=("temperature 1", "t1", "aux temperature", "aux0 temperature", "aux1 temperature", "temperature"),
        state=("step type", "status", "state", "step name"),
        signatures=(
            ("step type", "total time"),
            ("step type", "date"),
            ("data point", "total time", "date"),
            ("step type", "absolute time"),
            ("step name", "absolute time"),
            ("step name", "realtime"),
            ("relative time", "date"),
            ("step id", "record id", "date"),
            ("status", "date(h:min:s.ms)"),
        ),
        current_sign="charge_positive",
    ),
    Dialect(
        "Arbin",  # also the spreadsheets of CALCE
        time=("test time",),
        current=("current",),
        voltage=("voltage",),
        temperature=("aux temperature 1", "aux temperature", "temperature"),
        signatures=(("test time", "data point"), ("test time", "cycle index", "step index")),
        current_sign="charge_positive",
    ),
    Dialect(
        "Maccor",
        time=("test time", "test", "prog time"),
        current=("current", "amps", "mamps"),
        voltage=("voltage", "volts"),
        temperature=("temperature", "logtemp001", "temp 1", "evtemp"),
        state=("md", "state", "status"),
        signatures=(("step", "md"), ("step", "state"), ("rec#", "amps", "volts"), ("rec#", "mamps", "volts")),
        current_sign="charge_positive",
    ),
    Dialect(
        "BioLogic",
        time=("time", "t"),
        current=("<i>", "i"),
        voltage=("ecell", "<ecell>", "ewe", "<ewe>"),  # with a reference electrode, Ewe is the voltage of one electrode
        temperature=("temperature",),
        signatures=(("ewe",), ("<ewe>",), ("ecell",), ("<ecell>",)),
        current_sign="charge_positive",
    ),
    Dialect(
        "Digatron",
        time=("timestamp",),  # the column "Program Duration#s" may contain milliseconds
        current=("current",),
        voltage=("voltage",),
        temperature=("t1", "tenv"),
        state=("status",),
        signatures=(("timestamp", "voltage#v", "current#a"),),
        current_sign="charge_positive",
    ),
    Dialect(
        "PyBaMM",
        time=("time",),
        current=("current",),
        voltage=("terminal voltage", "battery voltage", "voltage"),
        temperature=("volume-averaged cell temperature", "cell temperature", "temperature"),
        signatures=(("current [a]", "terminal voltage [v]"), ("current [a]", "battery voltage [v]")),
        current_sign="discharge_positive",
    ),
    Dialect(
        "PyBaMM or PyBOP",  # other programs write these names too, so that the names do not define the sign
        time=("time",),
        current=("current", "current function"),
        voltage=("voltage",),
        temperature=("volume-averaged cell temperature", "cell temperature", "temperature"),
        signatures=(
            ("time [s]", "current [a]", "voltage [v]"),
            ("time [s]", "current function [a]", "voltage [v]"),
            ("time [min]", "current [a]", "voltage [v]"),
            ("time [h]", "current [a]", "voltage [v]"),
        ),
    ),
    Dialect(
        "NASA",
        time=("time",),
        current=("current measured",),
        voltage=("voltage measured",),
        temperature=("temperature measured",),
        signatures=(("time", "current measured", "voltage measured"),),
        current_sign="charge_positive",
    ),
    Dialect(
        "Novonix",
        time=("run time",),
        current=("current",),
        voltage=("potential",),
        temperature=("temperature", "circuit temperature"),
        signatures=(("run time", "step time", "potential"),),
        current_sign="charge_positive",
    ),
    Dialect(
        "PX4",
        time=("timestamp",),
        current=("current",),
        voltage=("voltage",),
        temperature=("temperature",),
        instance=("id",),
        series=("cell_count",),
        signatures=(("timestamp", "voltage_v", "current_a", "cell_count"),),
        time_unit="us",
        current_sign="discharge_positive",
    ),
    Dialect(
        "ArduPilot",
        time=("timeus",),
        current=("curr",),
        voltage=("volt",),
        temperature=("temp",),
        instance=("inst", "instance"),
        signatures=(("timeus", "volt", "curr"),),
        time_unit="us",
        current_sign="discharge_positive",
    ),
    Dialect(
        "VESC Tool",
        time=("ms today",),
        current=("current in",),
        voltage=("input voltage",),
        signatures=(("ms_today", "input_voltage", "current_in"),),
        time_unit="ms",
        current_sign="discharge_positive",
    ),
    Dialect(
        "Victron VRM",
        time=("timestamp",),
        current=("battery monitor current",),
        voltage=("battery monitor voltage",),
        temperature=("battery monitor battery temperature",),
        signatures=(("timestamp", "battery monitor current", "battery monitor voltage"),),
        current_sign="charge_positive",
    ),
    GENERIC,
)
"""All dialects, in the order in which they are tried."""
