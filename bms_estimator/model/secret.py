"""What must not be shown to whoever reads a log or looks at a terminal."""

import re


def without_secrets(text: str) -> str:
    """Text of a URL, or of several, without what stands before the last @: a name and a password, however it is written."""
    return re.sub(r".*@", "***@", text, flags=re.DOTALL)
