"""Binary files with the measurement of ``cycler_exports``, built by the definitions of their formats.

No genuine file is shipped with fastnda, galvani or python-calamine. Therefore these functions write the smallest files with
the structure that fastnda and galvani document (Neware's version 29, BioLogic's data module 2) and ECMA-376 (xlsx).
"""

import zipfile
from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from tests.sources.captures.cycler_exports import START, Measurement

NEWARE_RECORD = np.dtype(
    [
        ("identifier", "u1"), ("zero", "u1"), ("index", "<u4"), ("cycle", "<u4"), ("step_index", "<u2"),
        ("step_type", "u1"), ("jump", "u1"), ("step_time_ms", "<u8"), ("voltage", "<i4"), ("current", "<i4"),
        ("unused", "V8"), ("counters", "V32"), ("year", "<u2"), ("month", "u1"), ("day", "u1"), ("hour", "u1"),
        ("minute", "u1"), ("second", "u1"), ("padding", "V1"), ("range", "<i4"), ("end", "V4"),
    ]
)  # fmt: skip
"""Record of a .nda file of version 29, 86 bytes."""
CC_CHARGE, CC_DISCHARGE, REST = 1, 2, 4
"""Codes of steps in .nda files."""
RANGE_MA, CURRENT_LSB_MA = 6000, 0.1
"""Current range of the instrument, and the value of one unit of current in this range."""


def write_nda(path: Path, m: Measurement) -> None:
    """Write a Neware file of version 29."""
    records = np.zeros(m.step.size, dtype=NEWARE_RECORD)
    records["identifier"], records["index"] = 0x55, np.arange(1, m.step.size + 1)
    records["step_index"] = records["jump"] = m.step + 1
    records["step_type"] = m.states(str(CC_DISCHARGE), str(CC_CHARGE), str(REST))
    records["step_time_ms"] = 1e3 * np.concatenate([np.arange(np.count_nonzero(m.step == step)) for step in range(4)])
    records["voltage"] = np.rint(1e4 * m.voltage_v)
    records["current"] = np.rint(1e3 * m.charge_a / CURRENT_LSB_MA)
    times = [START + timedelta(seconds=second) for second in m.time_s]
    for part in ("year", "month", "day", "hour", "minute", "second"):
        records[part] = [getattr(time, part) for time in times]
    records["range"] = RANGE_MA
    header = bytearray(2304)
    header[:6], header[14] = b"NEWARE", 29
    path.write_bytes(bytes(header) + records.tobytes())


def write_mpr(path: Path, m: Measurement) -> None:
    """Write a BioLogic file with the columns mode, time, Ewe and I."""
    columns = np.array([1, 4, 6, 8], dtype="<u2")
    records = np.zeros(m.step.size, dtype=[("flags", "u1"), ("time_s", "<f8"), ("ewe_v", "<f4"), ("i_ma", "<f4")])
    records["time_s"], records["ewe_v"], records["i_ma"] = m.time_s, m.voltage_v, 1e3 * m.charge_a
    head = np.uint32(m.step.size).tobytes() + np.uint8(columns.size).tobytes() + columns.tobytes()
    data = head.ljust(405, b"\0") + records.tobytes()
    magic = b"BIO-LOGIC MODULAR FILE\x1a".ljust(48) + b"\0" * 4
    path.write_bytes(magic + _module(b"VMP Set", b"", version=0) + _module(b"VMP data", data, version=2))


def _module(name: bytes, data: bytes, version: int) -> bytes:
    header = name.ljust(10) + name.ljust(25) + np.array([len(data), version], dtype="<u4").tobytes() + b"03/12/24"
    return b"MODULE" + header + data


def write_xlsx(path: Path, sheets: Mapping[str, Sequence[Sequence[object]]]) -> None:
    """Write a workbook; text is stored in the cells, numbers as numbers."""
    ns = "http://schemas.openxmlformats.org"
    names = list(sheets)
    numbers = range(1, len(names) + 1)
    overrides = "".join(
        f'<Override PartName="/xl/worksheets/sheet{n}.xml" ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.worksheet+xml"/>'
        for n in numbers
    )
    links = "".join(
        f'<Relationship Id="r{n}" Type="{ns}/officeDocument/2006/relationships/worksheet" Target="worksheets/sheet{n}.xml"/>'
        for n in numbers
    )
    entries = "".join(
        f'<sheet name="{escape(name)}" sheetId="{n}" r:id="r{n}"/>' for n, name in zip(numbers, names, strict=True)
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{ns}/package/2006/content-types"><Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
            f'<Override PartName="/xl/workbook.xml" ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"/>{overrides}</Types>',
        )
        archive.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{ns}/package/2006/relationships"><Relationship Id="r1" Type="{ns}/officeDocument/2006/relationships/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        archive.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{ns}/spreadsheetml/2006/main" xmlns:r="{ns}/officeDocument/2006/relationships"><sheets>{entries}</sheets></workbook>',
        )
        archive.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{ns}/package/2006/relationships">{links}</Relationships>',
        )
        for n, rows in zip(numbers, sheets.values(), strict=True):
            body = "".join(f"<row>{''.join(map(_cell, row))}</row>" for row in rows)
            archive.writestr(
                f"xl/worksheets/sheet{n}.xml",
                f'<worksheet xmlns="{ns}/spreadsheetml/2006/main"><sheetData>{body}</sheetData></worksheet>',
            )


def _cell(value: object) -> str:
    if isinstance(value, str):
        return f'<c t="inlineStr"><is><t>{escape(value)}</t></is></c>'
    return f"<c><v>{value}</v></c>"


def arbin_sheets(m: Measurement) -> dict[str, list[list[object]]]:
    """Return the sheets of an Arbin workbook, as in the data of CALCE: information, samples in two sheets, statistics."""
    header = [
        "Data_Point",
        "Test_Time(s)",
        "Date_Time",
        "Step_Time(s)",
        "Step_Index",
        "Cycle_Index",
        "Current(A)",
        "Voltage(V)",
    ]
    rows = [
        [i + 1, m.time_s[i], 45363.99, 0.0, int(m.step[i]) + 1, 1, m.charge_a[i], m.voltage_v[i]]
        for i in range(m.step.size)
    ]
    statistics = [["Cycle_Index", "Test_Time(s)", "Current(A)", "Voltage(V)", "Step_Index"], [1, 80.0, 0.75, 3.9, 4]]
    return {
        "Info": [["TEST REPORT"], ["Test Name", "cell 8"]],
        "Channel_1-008_1": [header, *rows[:40]],
        "Channel_1-008_2": [header, *rows[40:]],
        "Statistics_1-008": statistics,
    }
