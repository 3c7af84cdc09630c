"""Comparison with a multimeter on the command line: from options, or by prompts."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial
from typing import Any

import typer

from bms_estimator.cli.options.table import show_status
from bms_estimator.cli.settings.prompts import Prompts
from bms_estimator.model.errors import UserError
from bms_estimator.setup.answers import InvalidAnswerError, parse_number
from bms_estimator.setup.comparison import Comparison
from bms_estimator.setup.found_device import FoundDevice


@dataclass(frozen=True)
class MultimeterOptions:
    """Options of the comparison; None: not given."""

    compare: bool | None
    voltmeter_v: float | None
    """Voltage that the multimeter shows [V]."""
    zero: bool
    """True if no current flows now."""
    ammeter_a: float | None
    """Current that the multimeter shows [A], positive on discharge."""
    direction: str | None
    """Direction of the present current: discharging or charging."""

    @property
    def has_current(self) -> bool:
        """True if an option states a current or its direction."""
        return self.ammeter_a is not None or self.direction is not None

    @property
    def has_values(self) -> bool:
        """True if an option is a value of the comparison. The comparison then uses only options, and nothing is asked."""
        return self.voltmeter_v is not None or self.zero or self.has_current


def compare_with_multimeter(
    prompts: Prompts, device: FoundDevice, options: MultimeterOptions
) -> tuple[tuple[str, object], ...]:
    """Compare voltage and current with a multimeter; return the settings of ``[sensor]``, as key and value.

    Raises:
        UserError: An option is invalid or missing, or the device does not answer.
    """
    comparison = Comparison(device)
    if options.has_values:
        _compare_options(comparison, options)
    elif prompts.confirm("Compare the device with a multimeter?", "--compare", options.compare, default=False):
        if not prompts.is_interactive:
            raise UserError(
                "--compare: give --voltmeter-v, --zero, --ammeter-a or --direction, because there is no terminal to ask"
            )
        _compare_interactively(comparison)
    else:
        return ()
    return asyncio.run(comparison.finish())


def _compare_options(comparison: Comparison, options: MultimeterOptions) -> None:
    if options.zero and options.has_current:
        raise UserError("--zero: no current flows, but --ammeter-a or --direction states one; give only one of them")
    try:
        if options.voltmeter_v is not None:
            _run(partial(comparison.compare_voltage, options.voltmeter_v))
        if options.zero:
            _run(comparison.set_zero)
        if options.ammeter_a is not None:
            _run(partial(comparison.compare_current, options.ammeter_a))
        elif options.direction is not None:
            _run(partial(comparison.compare_direction, options.direction))
    except InvalidAnswerError as error:
        raise UserError(f"comparison with the multimeter: {error}") from None


def _compare_interactively(comparison: Comparison) -> None:
    typer.echo("Press Enter without a value to skip a step.")
    first_v = "Voltage at the terminals of the pack by the multimeter [V]"
    if _ask_and_compare(first_v, lambda text: comparison.compare_voltage(parse_number(text, "V"))):
        second_v = "Voltage again at another state of charge, after you charged or discharged the pack [V]"
        _ask_and_compare(second_v, lambda text: comparison.compare_voltage(parse_number(text, "V")))
    _ask_and_compare("Switch off all loads and chargers; then enter 0", partial(_set_zero, comparison))
    load = "Switch on a load; its current by the multimeter [A], negative while the pack is charged"
    if not _ask_and_compare(load, lambda text: comparison.compare_current(parse_number(text, "A"))):
        _ask_and_compare(
            "The pack is now discharging or charging", lambda text: comparison.compare_direction(text.lower())
        )


def _set_zero(comparison: Comparison, text: str) -> Coroutine[Any, Any, str]:
    if text != "0":
        raise InvalidAnswerError(f"{text}: must be 0; press Enter without a value to skip this step")
    return comparison.set_zero()


def _ask_and_compare(text: str, compare: Callable[[str], Coroutine[Any, Any, str]]) -> bool:
    """Ask for a value until the comparison accepts it. Return False if the step is skipped."""
    while answer := str(typer.prompt(text, default="", show_default=False)).strip():
        try:
            _run(partial(compare, answer))
        except (InvalidAnswerError, UserError) as error:
            typer.echo(f"  {error}")
        else:
            return True
    return False


def _run(compare: Callable[[], Coroutine[Any, Any, str]]) -> None:
    with show_status("measuring"):
        result = asyncio.run(compare())
    typer.echo(f"  {result}")
