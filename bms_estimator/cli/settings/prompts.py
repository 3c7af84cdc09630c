"""Prompts of the wizard. A given option replaces a prompt, and ``--yes`` takes the default."""

import sys
from collections.abc import Callable
from typing import TypeVar

import typer

from bms_estimator.model.errors import UserError
from bms_estimator.setup.answers import InvalidAnswerError

Answer = TypeVar("Answer")


class Prompts:
    """Prompts on the terminal.

    Args:
        yes: True to take the default of each question that no option answers.
    """

    def __init__(self, *, yes: bool) -> None:
        self._yes, self._is_terminal = yes, sys.stdin.isatty()

    @property
    def is_interactive(self) -> bool:
        """True if questions are asked."""
        return self._is_terminal and not self._yes

    def ask(
        self, text: str, option: str, given: object, parse: Callable[[str], Answer], *, default: str = ""
    ) -> Answer:
        """Return the answer to a question. After an invalid answer, print the reason and ask again.

        Args:
            text: Text of the prompt.
            option: Option that answers the question.
            given: Value of the option; None: not given.
            parse: Converts the text of an answer; raises InvalidAnswerError.
            default: Default answer; empty without one.

        Raises:
            UserError: The option is invalid, or missing without a terminal.
        """
        if given is None and self.is_interactive:
            return self._prompt(f"{text} [{default}]" if default else text, parse, default)
        if given is None and not (self._yes and default):
            reason = "there is no default" if self._yes else "there is no terminal to ask"
            raise UserError(f"{option}: missing, and {reason}")
        try:
            return parse(default if given is None else str(given))
        except InvalidAnswerError as error:
            raise UserError(f"{option} {error}") from None

    def confirm(self, text: str, option: str, given: bool | None, *, default: bool) -> bool:
        """Return the answer to a question with the answers yes and no.

        Raises:
            UserError: The option is missing without a terminal.
        """
        if given is not None:
            return given
        if self.is_interactive:
            choices, answer = ("Y/n", "y") if default else ("y/N", "n")
            return self._prompt(f"{text} [{choices}]", _parse_yes_or_no, answer)
        if self._yes:
            return default
        raise UserError(f"{option}: missing, and there is no terminal to ask")

    @staticmethod
    def _prompt(text: str, parse: Callable[[str], Answer], default: str) -> Answer:
        while True:
            text_given = typer.prompt(text, default=default, show_default=False)
            if not text_given:
                typer.echo("  an answer is required, because there is no default")
                continue
            try:
                return parse(text_given)
            except InvalidAnswerError as error:
                typer.echo(f"  {error}")


def _parse_yes_or_no(text: str) -> bool:
    """Return True for yes.

    Raises:
        InvalidAnswerError: The text is neither yes nor no.
    """
    answer = text.strip().lower()
    if answer not in ("y", "yes", "n", "no"):
        raise InvalidAnswerError(f"{text}: must be y or n")
    return answer.startswith("y")
