"""What must not be shown to whoever reads a log or looks at a terminal."""

import re


def without_secrets(text: str) -> str:
    """Text of a URL, or of several, without the name and the password that may stand before an @."""
    return re.sub(r"//.*@", "//***@", text, flags=re.DOTALL)
