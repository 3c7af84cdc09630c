"""Requests that people and dashboards may make of a running service."""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from bms_estimator.model.errors import UserError

Handler = Callable[[Mapping[str, Any]], Awaitable[Mapping[str, Any]]]
"""Takes the request's arguments, returns the response's data. Raises UserError when it cannot be granted."""


class Requests:
    """Handlers by name. ``answer`` is what sinks call."""

    def __init__(self) -> None:
        self._handlers: dict[str, Handler] = {}

    def offer(self, name: str, handler: Handler) -> None:
        """Make a request known."""
        self._handlers[name] = handler

    async def answer(self, name: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Answer one request.

        Raises:
            UserError: No such request, or it cannot be granted.
        """
        handler = self._handlers.get(name)
        if handler is None:
            raise UserError(f"{name}: no such request; there are {', '.join(sorted(self._handlers))}")
        return await handler(arguments)


def number(arguments: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """The number ``name`` of a request's arguments.

    Raises:
        UserError: It is missing, no number, or outside ``low``..``high``.
    """
    value = arguments.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise UserError(f"{name} = {value!r}: must be a number from {low:g} to {high:g}")
    return float(value)
