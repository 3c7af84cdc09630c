"""``bms-estimator capacity``: capacity from rests and the charge between them."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console, Group
from rich.table import Table

from bms_estimator.calibration.capacity import Capacity, measure_capacity
from bms_estimator.calibration.capacity_anchors import Anchor
from bms_estimator.cli.options.capture_input import load_captures
from bms_estimator.cli.options.capture_options import (
    CAPTURE_FORMATS,
    CELL_HELP,
    AsJson,
    CapacityAh,
    MappedColumns,
    SignOfCurrent,
    complete_battery,
)
from bms_estimator.cli.options.pack_options import decimal
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.errors import UserError

MAX_SHOWN_ANCHORS = 30
"""Maximum number of printed anchors, which are rests with an SOC; ``--json`` prints all."""
MAX_CAPACITY_RATIO = 30.0
"""Maximum ratio of measured and declared capacity, in either direction. A larger ratio results from wrong units."""


@dataclass(frozen=True)
class AnchorResult:
    """Anchor, a rest with its SOC, in the output of ``--json``."""

    capture: str
    time_s: float
    rest_s: float
    ocv_v: float
    ocv_std_v: float
    """Standard deviation of the rest's OCV, without the error of the OCV curve."""
    soc: float
    soc_std: float
    counted_ah: float
    off: float
    """SOC from the rest's voltage minus SOC from the counted charge."""


@dataclass(frozen=True)
class CapacityResult:
    """Output of ``--json``."""

    capacity_ah: float
    capacity_std_ah: float
    declared_ah: float
    current_offset_a: float
    current_offset_std_a: float
    anchors: list[AnchorResult]
    rejected: list[str]


def capacity(
    captures: Annotated[
        list[Path],
        typer.Argument(help=f"captures of one cell, with rests; each {CAPTURE_FORMATS}", show_default=False),
    ],
    cell: Annotated[
        str,
        typer.Option(
            help=f"{CELL_HELP}; only the OCV of the cell is used", autocompletion=complete_battery, show_default=False
        ),
    ],
    capacity_ah: CapacityAh = None,
    current_offset_std_a: Annotated[
        float | None,
        typer.Option(
            parser=decimal(0.0),
            help="standard deviation of the current sensor's offset [A]; default: 0.7 % of the 1C current",
            show_default=False,
        ),
    ] = None,
    current_sign: SignOfCurrent = None,
    column_map: MappedColumns = None,
    as_json: AsJson = False,
) -> None:
    """Measure a cell's capacity from rests and the charge that is counted between them.

    The voltage of each rest gives an SOC by the OCV curve of --cell. The loads between the rests may have any form.
    From all rests the charge between full and empty is estimated, with its standard deviation.
    No cell file is written. Enter the result in a cell file: the capacity as `cell.capacity_ah`,
    and its standard deviation divided by the capacity as `cell.capacity_std`.
    """
    model = load_cell(cell, capacity_ah)
    loaded = load_captures(captures, current_sign=current_sign, column_map=column_map)
    measured = measure_capacity(loaded, model, offset_std_a=current_offset_std_a)
    if not 1.0 / MAX_CAPACITY_RATIO < measured.capacity_ah / model.cell.capacity_ah < MAX_CAPACITY_RATIO:
        raise UserError(
            f"{measured.capacity_ah:.4g} Ah, but {model.cell.capacity_ah:.4g} Ah is declared: is the current in amperes and "
            "the time in seconds?"
        )
    result = _result(measured, model)
    if as_json:
        sys.stdout.write(json.dumps(asdict(result)) + "\n")
    else:
        Console().print(_as_table(result))


def _result(measured: Capacity, cell: CellModel) -> CapacityResult:
    return CapacityResult(
        capacity_ah=measured.capacity_ah,
        capacity_std_ah=measured.std_ah,
        declared_ah=cell.cell.capacity_ah,
        current_offset_a=measured.offset_a,
        current_offset_std_a=measured.offset_std_a,
        anchors=[
            _anchor_result(anchor, soc_error)
            for anchor, soc_error in zip(measured.anchors, measured.residual, strict=True)
        ],
        rejected=list(measured.rejected),
    )


def _anchor_result(anchor: Anchor, soc_error: float) -> AnchorResult:
    return AnchorResult(
        capture=anchor.capture,
        time_s=anchor.time_s,
        rest_s=anchor.rest.duration_s,
        ocv_v=anchor.rest.ocv_v,
        ocv_std_v=anchor.voltage_std_v,
        soc=anchor.soc,
        soc_std=anchor.soc_std,
        counted_ah=anchor.counted_ah,
        off=soc_error,
    )


def _anchor_count_text(count: int) -> str:
    omission = f", the first {MAX_SHOWN_ANCHORS} above (--json: all)" if count > MAX_SHOWN_ANCHORS else ""
    return f"{count} anchors{omission}"


def _as_table(result: CapacityResult) -> Group:
    """Return a table of the anchors, with the results below it."""
    anchors = Table("capture", "until", "rest", "OCV", "SOC", "counted", "SOC error", box=box.SIMPLE_HEAD)
    for column in anchors.columns[1:]:
        column.justify, column.no_wrap = "right", True
    for anchor in result.anchors[:MAX_SHOWN_ANCHORS]:
        anchors.add_row(
            anchor.capture,
            f"{anchor.time_s:.0f} s",
            f"{anchor.rest_s / 60.0:.0f} min",
            f"{anchor.ocv_v:.4f} V",
            f"{anchor.soc:.3f} ± {anchor.soc_std:.3f}",
            f"{anchor.counted_ah:.3f} Ah",
            f"{anchor.off:+.3f}",
        )
    lines = [
        f"capacity {result.capacity_ah:.4g} ± {result.capacity_std_ah:.2g} Ah, declared {result.declared_ah:.4g} Ah",
        f"offset of the current sensor {1e3 * result.current_offset_a:+.1f} ± {1e3 * result.current_offset_std_a:.1f} mA",
        f"{_anchor_count_text(len(result.anchors))}, {len(result.rejected)} rejected rests",
    ]
    return Group(anchors, *lines)
