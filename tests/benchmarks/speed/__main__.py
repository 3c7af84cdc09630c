"""Table of the benchmarks: ``make benchmark`` for all, ``make benchmark ARGS="kernel live"`` for some."""

import sys
from itertools import chain

from tests.benchmarks.fleet import partition
from tests.benchmarks.speed import capture, cells, forecast, kernel, live, packs
from tests.benchmarks.table import show

GROUPS = {  # each function yields the rows of the table
    "kernel": kernel.rows,
    "forecast": forecast.rows,
    "cells": cells.rows,
    "forecast_request": forecast.request_rows,
    "capture": capture.rows,
    "live": live.rows,
    "packs": packs.rows,
    "partition": partition.rows,
}


def main() -> None:
    names = sys.argv[1:] or list(GROUPS)
    unknown = [name for name in names if name not in GROUPS]
    if unknown:
        sys.exit(f"no such benchmark: {', '.join(unknown)}; there are {', '.join(GROUPS)}")
    show(chain.from_iterable(GROUPS[name]() for name in names))


main()
