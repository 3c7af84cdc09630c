"""``bms-estimator new``: wizard that finds the device of a pack and writes its settings file."""

import asyncio
import shlex
import subprocess
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from bms_estimator.cli.options.pack_options import decimal
from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.cli.options.table import show_status
from bms_estimator.cli.settings.multimeter_prompts import MultimeterOptions, compare_with_multimeter
from bms_estimator.cli.settings.prompts import Prompts
from bms_estimator.installation.machine import root_command
from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import configure_logs
from bms_estimator.service.kernel_compilation import background_compilation
from bms_estimator.service.kernel_warm_up import load_kernels
from bms_estimator.settings.connections import PageSettings
from bms_estimator.settings.pack import require_new
from bms_estimator.setup.answers import Answers, InvalidAnswerError
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.first_estimate import current_note, estimate_text, run_estimator
from bms_estimator.setup.found_device import FoundDevice
from bms_estimator.setup.measurement import Measurement, measure
from bms_estimator.setup.new_pack import create_pack, run_command
from bms_estimator.setup.questions import QUESTIONS, Question
from bms_estimator.setup.search import PLACES, SearchResult, default_places, missing_packages, search

ESTIMATE_S = 5.0
"""Time over which the first estimates are shown [s]."""


def new(
    file: Annotated[Path, typer.Argument(help="settings file to create")] = Path("pack.toml"),
    search_at: Annotated[
        list[str] | None,
        typer.Option(
            "--search",
            help="where to search: path of a serial port, URL of an MQTT broker (mqtt://user:pw@host), host name of a Modbus device, or bluetooth; may be repeated; default: asked on a terminal, otherwise all USB serial ports, the MQTT broker on this machine, and Bluetooth if its package is installed",
            show_default=False,
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="path of a serial port, which is then the only place that is searched, or name of a found device, such as esphome-jk:jk-bms"
        ),
    ] = None,
    compare: Annotated[
        bool | None,
        typer.Option("--compare/--no-compare", help="compare the device with a multimeter", show_default=False),
    ] = None,
    voltmeter_v: Annotated[
        float | None,
        typer.Option(parser=decimal(0.0), help="present voltage of the pack by a multimeter [V]", show_default=False),
    ] = None,
    zero: Annotated[
        bool, typer.Option("--zero", help="all loads and chargers are off: take the measured current as zero")
    ] = False,
    ammeter_a: Annotated[
        float | None,
        typer.Option(
            parser=decimal(), help="present current by a multimeter [A], positive on discharge", show_default=False
        ),
    ] = None,
    direction: Annotated[
        str | None,
        typer.Option(help="direction of the present current, discharging or charging; corrects the sign"),
    ] = None,
    name: Annotated[str | None, typer.Option(help=QUESTIONS[0].help, show_default=False)] = None,
    cell: Annotated[str | None, typer.Option(help=QUESTIONS[1].help, show_default=False)] = None,
    capacity_ah: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[2].help, show_default=False)
    ] = None,
    series: Annotated[str | None, typer.Option(metavar="<int>", help=QUESTIONS[3].help, show_default=False)] = None,
    parallel: Annotated[str | None, typer.Option(metavar="<int>", help=QUESTIONS[4].help, show_default=False)] = None,
    full_voltage_v: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[5].help, show_default=False)
    ] = None,
    cutoff_voltage_v: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[6].help, show_default=False)
    ] = None,
    max_discharge_a: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[7].help, show_default=False)
    ] = None,
    max_charge_a: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[8].help, show_default=False)
    ] = None,
    device_soc_std: Annotated[
        str | None, typer.Option(metavar="<float>", help=QUESTIONS[9].help, show_default=False)
    ] = None,
    broker: Annotated[str | None, typer.Option(help=QUESTIONS[10].help, show_default=False)] = None,
    estimate: Annotated[
        bool, typer.Option("--estimate/--no-estimate", help="run the estimator for some seconds, and show the SOC")
    ] = True,
    install: Annotated[
        bool | None,
        typer.Option("--install/--no-install", help="install the service with sudo", show_default=False),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="take the default of each question that no option answers")
    ] = False,
) -> None:
    """Find the device of a pack, ask for the values of the pack, and write its settings file.

    Each question is asked on the terminal unless its option answers it.
    Without a terminal, a missing option is an error.
    """
    require_new(file)
    configure_logs(deque[str](maxlen=1))  # the wizard reports faults itself
    # the compilation takes a minute or more, in which the user answers the questions
    with background_compilation() if estimate else nullcontext() as finish_compilation, _report_interruption(file):
        prompts = Prompts(yes=yes)
        places = search_at or ([device] if device and device.startswith("/") else _places(prompts))
        answers = _choose_device(prompts, _log_in(prompts, _search(places)), device)
        measured = _measure(answers.device)
        meter = MultimeterOptions(compare, voltmeter_v, zero, ammeter_a, direction)
        sensor = compare_with_multimeter(prompts, answers.device, meter) if measured else ()
        answers = replace(answers, measured=measured, name=file.stem, sensor=sensor)
        # in the order of ``QUESTIONS``, like the help texts above
        given = (
            *(name, cell, capacity_ah, series, parallel),
            *(full_voltage_v, cutoff_voltage_v, max_discharge_a, max_charge_a),
            *(device_soc_std, broker),
        )
        for question, option in zip(QUESTIONS, given, strict=True):
            if option is not None or question.is_asked(answers):
                answers = _ask(prompts, question, option, answers)
        pack = create_pack(file, answers)
        for warning in pack.warnings:
            typer.echo(f"warning: {warning}", err=True)
        passwords = (f"{path}: written, mode 600; password for the broker" for path in pack.password_files)
        typer.echo("\n".join((f"{file}: written; {pack.summary}", *passwords)))
        if finish_compilation and measured:
            compile_ahead(compile_all=finish_compilation)
            load_kernels()
            asyncio.run(
                run_estimator(
                    pack.settings, pack.cell, lambda estimate: typer.echo(estimate_text(estimate)), seconds=ESTIMATE_S
                )
            )
            if note := current_note(measured.current_a, pack.cell.cell.capacity_ah):
                typer.echo(note)
        _offer_install(prompts, file, install, pack.settings.page)


@contextmanager
def _report_interruption(file: Path) -> Iterator[None]:
    """Report Ctrl-C or the end of the input within the context, and whether the file is written.

    Raises:
        typer.Exit: The user interrupted the command.
    """
    try:
        yield
    except (typer.Abort, KeyboardInterrupt):
        typer.echo(f"\nInterrupted; {f'{file} is' if file.exists() else 'nothing was'} written.", err=True)
        raise typer.Exit(130) from None


def _places(prompts: Prompts) -> list[str]:
    """Return the places to search.

    On a terminal the user chooses them, because each search takes up to 20 s. Otherwise all default places are searched.
    """
    places = " ".join(default_places())
    if "/dev/" not in places:
        typer.echo("-  no USB serial port is connected; --search PATH searches another serial port")
    for kind, command in missing_packages().items():
        typer.echo(f"-  {kind}: not searched, because a package is missing: {command}")
    return prompts.ask(
        f"Where to search ({_place_kinds()})",
        "--search",
        None if prompts.is_interactive else places,
        str.split,
        default=places,
    )


def _place_kinds() -> str:
    """Return the kinds of places that can be searched."""
    return ", ".join(kind for kind in PLACES if kind not in missing_packages())


def _search(places: Sequence[str], earlier: Sequence[FoundDevice] = ()) -> SearchResult:
    """Search the places, and print what was found, after the devices that were found earlier."""
    with show_status(f"searching {', '.join(map(without_secrets, places))}: up to 20 s"):
        result = asyncio.run(search(places))
    result.devices = list({device.name: device for device in (*earlier, *result.devices)}.values())
    found = (f"{number}  {device.name}: {device}" for number, device in enumerate(result.choices, start=1))
    typer.echo("\n".join((*found, *(f"-  {failure}" for failure in result.failures))))
    return result


def _choose_device(prompts: Prompts, result: SearchResult, device: str | None) -> Answers:
    """Return the answers with the chosen device. On a terminal, the user may search another place instead of choosing.

    Raises:
        UserError: No device was found, or there is no clear choice and no terminal.
    """
    if not result.devices and device is None and not prompts.is_interactive:
        raise UserError("--search: no device was found; give its place: --search PLACE")
    may_search = prompts.is_interactive and device is None
    while True:
        parse = partial(_parse_device, result=result, may_search=may_search)
        text = f"Number of the device, or another place to search ({_place_kinds()})"
        chosen = prompts.ask(text, "--device", device, parse, default="1" if len(result.choices) == 1 else "")
        if isinstance(chosen, FoundDevice):
            return Answers(chosen, found_broker=result.broker)
        new_result = _log_in(prompts, _search([chosen], result.devices))
        result = replace(new_result, broker=new_result.broker or result.broker)


def _log_in(prompts: Prompts, result: SearchResult) -> SearchResult:
    """Ask for the login of each broker that requires one, and search the broker again, until the login is right or empty.

    Without a terminal, print how to give the login.
    """
    while result.login_required:
        login, *others = result.login_required
        if not prompts.is_interactive:
            typer.echo(f"-  give the login as {login.url.replace('://', '://user:pw@')}")
            break
        typer.echo(f"   Enter the user name and the password{' again' if login.username else ''}.")
        username = str(
            typer.prompt(f"User name at {login.url} (empty: skip this broker)", default="", show_default=False)
        )
        if not username:
            result = replace(result, login_required=others)
            continue
        password = str(typer.prompt("Password", hide_input=True))
        new_result = _search([BrokerLogin(login.url, username, password).address], result.devices)
        result = replace(
            new_result,
            broker=new_result.broker or result.broker,
            login_required=new_result.login_required + others,
        )
    return result


def _parse_device(text: str, result: SearchResult, *, may_search: bool) -> FoundDevice | str:
    """Return the device with this name or number. If ``may_search`` is True, return any other text as a place to search.

    Raises:
        InvalidAnswerError: There is no device with this number or name. If the text is a place whose search failed, the message
            gives the reason of the failure.
    """
    for number, device in enumerate(result.choices, start=1):
        if text in (str(number), device.name):
            return device
    if text.isdigit() or not may_search:
        names = ", ".join(device.name for device in result.choices) or "no device"
        failures = (failure for failure in result.failures if failure.startswith(f"{text}: "))
        raise InvalidAnswerError(next(failures, f"{text}: was not found; found: {names}"))
    return text


def _measure(device: FoundDevice) -> Measurement | None:
    """Print and return the present values; None if no sample arrives."""
    try:
        with show_status("measuring"):
            measured = asyncio.run(measure(device.settings))
    except UserError as error:
        typer.echo(f"warning: {error}", err=True)
        return None
    typer.echo(f"measured: {measured}")
    return measured


def _ask(prompts: Prompts, question: Question, given: str | None, answers: Answers) -> Answers:
    if prompts.is_interactive and given is None:
        for choice, description in question.choices:
            typer.echo(f"  {choice:4} {description}")
        if question.explanation:
            typer.echo(f"  {question.explanation}")
    return prompts.ask(
        question.text,
        question.option,
        given,
        lambda text: question.answer(text, answers),
        default=question.suggest(answers),
    )


def _offer_install(prompts: Prompts, file: Path, given: bool | None, page: PageSettings | None) -> None:
    """Install the service, or print the commands that run and install it, and the address of its page.

    Raises:
        typer.Exit: The installation ended, with its exit code.
    """
    command = root_command("install", file)
    if prompts.confirm(
        "Install the service, which runs at each start of this machine?", "--install", given, default=False
    ):
        raise typer.Exit(subprocess.run(command, check=False).returncode)  # noqa: S603 - the program of this process
    address = f"; live page: http://{page.listen}" if page else ""
    typer.echo(f"run it here: {run_command(file)}{address}\ninstall the service: {shlex.join(command)}")
