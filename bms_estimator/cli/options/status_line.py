"""Status line of a command that waits."""

from contextlib import AbstractContextManager, nullcontext

from rich.console import Console


def show_status(text: str) -> AbstractContextManager[object]:
    """Show a text with a spinner within the context, if stderr is a terminal."""
    console = Console(stderr=True)
    return console.status(text) if console.is_terminal else nullcontext()
