"""Layout of a screen: text flows by the width, and the least important lines are dropped for lack of height."""

from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.segment import Segment
from rich.text import Text

GAP = "  "


class FlowLayout:
    """Texts beside each other, as many as a line takes; none is broken that a line can hold.

    Args:
        texts: Texts from left to right.
    """

    def __init__(self, *texts: Text) -> None:
        self._texts = texts

    def is_empty(self) -> bool:
        """Return True if there is no text."""
        return not self._texts

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Rich's protocol."""
        row = Text()
        for text in self._texts:
            if row and row.cell_len + len(GAP) + text.cell_len > options.max_width:
                yield row
                row = Text()
            row = Text.assemble(row, GAP, text) if row else text
        yield row


class LayoutBlock(NamedTuple):
    """A part of the screen, as wide as that is."""

    rank: int
    """0 stays longest."""
    content: RenderableType


def fitted(blocks: Sequence[LayoutBlock], console: Console, options: ConsoleOptions) -> RenderResult:
    """Blocks below each other.

    Where they are higher than the room there is, those of the highest rank are left out, the lowest on the screen first.
    """
    free = options.reset_height()
    shown = [(block.rank, console.render_lines(block.content, free, pad=False)) for block in blocks]
    while sum(len(lines) for _, lines in shown) > options.max_height and len(shown) > 1:
        del shown[max(range(len(shown)), key=lambda j: (shown[j][0], j))]
    for _, lines in shown:
        for row in lines:
            yield from row
            yield Segment.line()
