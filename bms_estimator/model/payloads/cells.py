"""Payload of the topic ``cells``."""

from typing import Literal

from pydantic import Field

from bms_estimator.model.payloads.payload import Payload

CellFaultName = Literal["internal short", "contact", "sense wire", "wrong reading", "stuck reading"]
"""Fault of a cell, or of the reading of its voltage."""


class CellReport(Payload):
    """One cell in series."""

    number: int = Field(description="number, from 1")
    soc: float = Field(description="state of charge, 0..1")
    soc_std: float = Field(description="standard deviation of soc")
    soc_deviation: float = Field(description="SOC less the mean SOC of the cells")
    soc_deviation_std: float = Field(description="standard deviation of soc_deviation")
    resistance_ratio: float = Field(description="resistance relative to the median of the cells")
    resistance_ratio_std: float = Field(description="standard deviation of resistance_ratio")
    capacity_ratio: float = Field(description="capacity relative to the median of the cells")
    self_discharge_a: float = Field(description="self-discharge current above the median of the cells [A]")
    self_discharge_std_a: float = Field(description="standard deviation of self_discharge_a [A]")
    fault: CellFaultName | None = Field(
        description="internal short: a fault of the cell; contact, sense wire, wrong reading, stuck reading: faults of the "
        "measurement of its voltage; null: none"
    )


class CellsReport(Payload):
    """Topic ``cells``, retained: comparison of the cells in series of a pack with cell voltages."""

    publish_time: str = Field(description="time at which this message was created, ISO 8601, UTC")
    weakest: int = Field(description="number of the cell with the lowest SOC, from 1")
    cells: list[CellReport] = Field(description="all cells, from number 1 on")
