"""Command group that imports a command only when it runs.

``--help`` therefore stays fast, and a missing optional package affects only the commands that need it.
"""

import importlib
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup


class LazyCommand(NamedTuple):
    """Command that has not been imported yet."""

    target: str
    """``module:name`` of a command function, or of a ``Typer`` that has subcommands."""
    help: str
    """Help text in the list of commands; a function's own docstring replaces it in the help of the command."""


class LazyGroup(TyperGroup):
    """Group that lists the commands in ``entries`` of a subclass and imports the one that is called."""

    entries: ClassVar[dict[str, LazyCommand]]

    def __init__(self, **attributes: Any) -> None:
        """Add a placeholder with the help text of each command, for the list and suggestions of commands."""
        super().__init__(**attributes)
        self.commands = {name: TyperCommand(name, help=entry.help) for name, entry in self.entries.items()}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Import and return the command that is called."""
        name, placeholder, remaining_args = super().resolve_command(ctx, args)
        command = import_command(name, self.entries[name]) if name in self.entries else placeholder
        return name, command, remaining_args


def import_command(name: str, entry: LazyCommand) -> Any:
    """Import a command or a group of commands."""
    module, attribute = entry.target.split(":")
    target = getattr(importlib.import_module(module), attribute)
    if not isinstance(target, typer.Typer):
        function, target = target, typer.Typer(add_completion=False)
        target.command(name, help=entry.help if not function.__doc__ else None)(function)
    command = typer.main.get_command(target)
    command.name = name
    return command
