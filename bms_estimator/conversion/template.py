"""Templates of exported files, in the folder ``templates``."""

from collections.abc import Sequence
from pathlib import Path
from string import Template

TEMPLATES = Path(__file__).with_name("templates")
LINE_VALUES = 6
"""Number of values on a line of a table."""


def fill_template(template: str, **values: object) -> str:
    """Return the text of a template with values in place of its placeholders, such as ``${name}``."""
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(values)


def value_lines(texts: Sequence[str], indent: int) -> str:
    """Return values as indented lines of at most ``LINE_VALUES``, separated by commas."""
    lines = (", ".join(texts[i : i + LINE_VALUES]) for i in range(0, len(texts), LINE_VALUES))
    return ",\n".join(" " * indent + line for line in lines)
