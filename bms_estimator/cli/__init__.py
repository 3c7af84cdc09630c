"""Command line: one module per command group, imported when its command is called."""

from bms_estimator.cli.main import main

__all__ = ["main"]
