"""``bms-estimator``: table of commands, error messages and exit codes."""

import errno
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from bms_estimator.cli.lazy_group import LazyCommand, LazyGroup
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.version import __version__

COMMANDS = {
    "new": LazyCommand(
        "bms_estimator.cli.settings.new:new", "Find the device of a pack, and write the settings file of the pack."
    ),
    "setup": LazyCommand(
        "bms_estimator.cli.settings.setup:setup", "Serve a web page with the questions of `bms-estimator new`."
    ),
    "run": LazyCommand(
        "bms_estimator.cli.live.run:run",
        "Run the live service: estimate from a BMS, monitor or sensor board, and publish.",
    ),
    "edge": LazyCommand("bms_estimator.cli.live.edge:edge", "Send a pack's raw samples to a fleet server."),
    "replay": LazyCommand(
        "bms_estimator.cli.captures.replay:replay",
        "Run the estimator over a capture: recorded raw bytes, a table or the export of a cycler.",
    ),
    "forecast": LazyCommand(
        "bms_estimator.cli.live.forecast:forecast",
        "Forecast the time to cut-off of a pack under an expected load.",
    ),
    "alarms": LazyCommand(
        "bms_estimator.cli.captures.alarms:alarms", "List the alarms that a capture would have raised."
    ),
    "record": LazyCommand(
        "bms_estimator.cli.live.record:record", "Record a device's raw bytes with their arrival times."
    ),
    "simulate": LazyCommand(
        "bms_estimator.cli.live.simulate:simulate", "Simulate a sensor board, BMS or battery monitor for tests."
    ),
    "ports": LazyCommand("bms_estimator.cli.live.ports:ports", "List serial ports, and identify the devices on them."),
    "board": LazyCommand(
        "bms_estimator.cli.live.board:board",
        "Show a sensor board's properties, and set its calibration and serial number.",
    ),
    "dashboard": LazyCommand(
        "bms_estimator.cli.live.dashboard:dashboard",
        "Serve a live web page of all packs that publish to an MQTT broker.",
    ),
    "demo": LazyCommand(
        "bms_estimator.cli.live.demo:demo", "Run an MQTT broker, a simulated board and the live service."
    ),
    "calibrate": LazyCommand(
        "bms_estimator.cli.cell.calibrate:calibrate_command",
        "Write a cell file for your own cell, from captures or by a guided test of a pack.",
    ),
    "ocv": LazyCommand(
        "bms_estimator.cli.cell.ocv:ocv",
        "Write a cell file with the OCV curve from rests, slow discharges or a table.",
    ),
    "identify": LazyCommand(
        "bms_estimator.cli.cell.identify:identify_command", "Write a cell file with the resistances that captures show."
    ),
    "adapt": LazyCommand(
        "bms_estimator.cli.cell.adapt:adapt_command",
        "Write a cell file by the method of the thesis; identify gives better files.",
    ),
    "capacity": LazyCommand(
        "bms_estimator.cli.cell.capacity:capacity", "Measure a cell's capacity from rests and the charge between them."
    ),
    "accuracy": LazyCommand(
        "bms_estimator.cli.cell.accuracy:accuracy",
        "Compute how accurately the SOC of a pack can be estimated, and which change helps most.",
    ),
    "cell": LazyCommand(
        "bms_estimator.cli.cell.commands:app",
        "Write a cell file from a pack's learned state, or convert a cell file for PyBaMM, JSON or C.",
    ),
    "history": LazyCommand("bms_estimator.cli.live.history:history", "Print a pack's stored history as CSV."),
    "validate": LazyCommand(
        "bms_estimator.cli.captures.validate:validate_command",
        "Compare the voltage of a cell file's model with a capture, open loop.",
    ),
    "convert": LazyCommand(
        "bms_estimator.cli.captures.convert:convert",
        "Write a capture as CSV, Parquet or Battery Data Format (BDF).",
    ),
    "report": LazyCommand(
        "bms_estimator.cli.captures.report:report",
        "Write a report with figures and a verdict, from captures or from a pack's history.",
    ),
    "thesis": LazyCommand(
        "bms_estimator.cli.captures.thesis:thesis",
        "Recompute the tables and figures of the thesis, and write a report.",
    ),
    "asyncapi": LazyCommand(
        "bms_estimator.cli.settings.asyncapi:asyncapi", "Print the MQTT topics and payloads as an AsyncAPI document."
    ),
    "fleet": LazyCommand("bms_estimator.cli.fleet.commands:app", "Estimate many packs: server, workers and queries."),
    "doctor": LazyCommand(
        "bms_estimator.cli.settings.doctor:doctor",
        "Examine settings, device, broker, service and machine; name a remedy for each fault.",
    ),
    "install": LazyCommand(
        "bms_estimator.cli.settings.install:install_command", "Install or upgrade the service on this machine."
    ),
    "uninstall": LazyCommand(
        "bms_estimator.cli.settings.install:uninstall_command", "Remove the service from this machine."
    ),
    "backup": LazyCommand(
        "bms_estimator.cli.settings.backup:backup", "Write settings and learned state of a pack to an archive."
    ),
    "restore": LazyCommand(
        "bms_estimator.cli.settings.backup:restore", "Restore settings and learned state of a pack from an archive."
    ),
    "compile": LazyCommand(
        "bms_estimator.cli.settings.compile:compile_command", "Compile the kernels before the first start."
    ),
    "config": LazyCommand("bms_estimator.cli.settings.config:app", "Write, check or show a pack's settings."),
}

EXTRAS = {
    "pyarrow": "parquet",
    "jinja2": "report",
    "scipy": "calibration",
    "matplotlib": "report",
    "prometheus_client": "prometheus",
    "pymodbus": "modbus",
    "can": "can",
    "cantools": "can",
    "aiobmsble": "ble",
    "bleak": "ble",
    "nats": "fleet",
    "duckdb": "fleet",
    "nkeys": "fleet",
    "python_calamine": "excel",
    "fastnda": "cycler",
    "galvani": "cycler",
}
"""Extra of ``bms_estimator`` that installs an optional package, by the module name of the package."""
DISK_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Error numbers of a full or broken disk. Their exit code makes systemd restart a service, because disk space may be
freed."""


class _Commands(LazyGroup):
    entries = COMMANDS

    def invoke(self, ctx: Any) -> Any:
        """Run a command. Ctrl-C or the end of the input at a prompt is an interruption, as anywhere else."""
        try:
            return super().invoke(ctx)
        except typer.Abort:
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},  # subcommands inherit them
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bms-estimator {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    _version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
    ),
) -> None:
    """Real-time estimator of a Li-ion battery: SOC, parameters and stability margins.

    The thesis, which some commands name, is "Adaptive Estimation of Li-ion Battery Model Parameters".
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    Exit codes: 0 success; 1 an internal error (with traceback), a closed stdout, a full or broken disk, or a fault that
    ``doctor`` found; 2 an error that the user can correct; 75 (EX_TEMPFAIL) a fault of the environment that may end; 130 interrupted.

    Args:
        arguments: Arguments without the program's name; None: those of the process.
    """
    if arguments is None:  # the process is the command's own
        # SIGUSR1 acknowledges alarms, and may come while the modules of ``run`` are imported
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    # The matrices are small: with more threads OpenBLAS needs twice the time, and a result on another number of cores could
    # differ in the last bit. numpy, which reads this once, is not imported yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        _run(arguments)
    except UserError as error:
        _exit_with_error(
            str(error), 1 if _is_disk_fault(error) else os.EX_TEMPFAIL if isinstance(error, TemporaryError) else 2
        )
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package not in EXTRAS:
            raise
        _exit_with_error(f"this command needs the package {package}: pip install 'bms_estimator[{EXTRAS[package]}]'")
    except BrokenPipeError:
        _redirect_stdout_to_null()
        sys.exit(1)
    except OSError as error:
        if not _is_disk_fault(error):
            raise
        _redirect_stdout_to_null()
        _exit_with_error(f"cannot write{f' {error.filename}' if error.filename else ''}: {error.strerror}", 1)
    except KeyboardInterrupt:  # during the import of a command; typer handles later ones
        sys.exit(130)


def _run(arguments: Sequence[str] | None) -> None:
    """Run the command line, and flush stdout while an error can still be reported."""
    try:
        app(None if arguments is None else list(arguments), prog_name="bms-estimator")
    except SystemExit:
        if sys.stdout:  # None if the process was started without a stdout
            sys.stdout.flush()
        raise


def _is_disk_fault(error: BaseException | None) -> bool:
    """Return True if the first OSError in an error's chain of causes is that of a full or broken disk."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error is not None and error.errno in DISK_FAULTS


def _redirect_stdout_to_null() -> None:
    """Redirect stdout to the null device, because the interpreter's flush at exit would fail again."""
    if not sys.stdout:
        return
    with Path(os.devnull).open("wb") as null:
        os.dup2(null.fileno(), sys.stdout.fileno())


def _exit_with_error(message: str, code: int = 2) -> None:
    for line in message.splitlines():
        sys.stderr.write(f"error: {line}\n")
    sys.exit(code)
