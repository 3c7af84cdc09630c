"""Benchmark of available power, usable capacity and time to full on real captures and simulated charges."""

import sys
import tempfile
from pathlib import Path

from rich.console import Console

from tests.benchmarks.capability.charges import charge_table
from tests.benchmarks.capability.discharges import discharge_table
from tests.benchmarks.capability.pulses import pulse_table
from tests.benchmarks.recipes import DATA


def main() -> None:
    """Print the three tables."""
    if not DATA.is_dir():
        sys.exit(f"{DATA}: the captures are not there")
    console = Console(width=None if sys.stdout.isatty() else 160)
    with tempfile.TemporaryDirectory() as folder:
        for table in (pulse_table, discharge_table, charge_table):
            console.print(table(Path(folder)))


if __name__ == "__main__":
    main()
