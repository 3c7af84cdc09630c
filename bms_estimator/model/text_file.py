"""Writing a text file, with an error that names it."""

from pathlib import Path

from bms_estimator.model.errors import UserError


def write_text(path: Path, text: str, *, make_folder: bool = False) -> None:
    """Write a file anew, in UTF-8.

    Args:
        path: Whatever is there.
        text: All of it.
        make_folder: Whether its folder is made where there is none.

    Raises:
        UserError: It cannot be written.
    """
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
