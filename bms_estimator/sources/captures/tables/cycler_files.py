"""Readers of binary files of cyclers: Neware .nda and .ndax with fastnda, BioLogic .mpr with galvani."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.column_tables import ArrayTable, ColumnTable
from bms_estimator.sources.captures.tables.layout_finder import LayoutFinder

NDA_MAGIC = b"NEWARE"
"""First bytes of Neware's .nda files."""
MPR_MAGIC = b"BIO-LOGIC MODULAR FILE"
"""First bytes of BioLogic's .mpr files."""
NDAX_MEMBER = ".ndc"
"""Ending of the names of members of Neware's .ndax files, which are zip archives."""


def read_neware(path: Path, finder: LayoutFinder, suffix: str) -> ArrayTable:
    """Read a file of a Neware cycler.

    Args:
        path: The file.
        finder: Finder of the columns of a sample.
        suffix: Kind of the file, ``.nda`` or ``.ndax``.

    Raises:
        UserError: The file is damaged or of an unknown version.
    """
    import fastnda  # noqa: PLC0415 - optional

    def read() -> ColumnTable:
        with _with_suffix(path, suffix) as renamed:
            return {column.name: column.to_numpy() for column in fastnda.read(renamed)}

    return ArrayTable(path, _call_library(path, read), finder, f"Neware {suffix}")


def read_biologic(path: Path, finder: LayoutFinder) -> ArrayTable:
    """Read a .mpr file of a BioLogic potentiostat.

    Raises:
        UserError: The file is damaged or has unknown columns.
    """
    from galvani import BioLogic  # noqa: PLC0415 - optional

    def read() -> ColumnTable:
        with path.open("rb") as file:
            data = BioLogic.MPRfile(file).data
        return {name: data[name] for name in data.dtype.names}

    return ArrayTable(path, _call_library(path, read), finder, "BioLogic .mpr")


def _call_library(path: Path, read: Callable[[], ColumnTable]) -> ColumnTable:
    """Return the table that a library reads. The library's warnings are suppressed, because they concern its internals.

    Raises:
        UserError: The library raised an error. All classes are caught, because neither library documents its errors.
    """
    logging.getLogger("fastnda").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    except Exception as error:  # noqa: BLE001
        reason = str(error) or type(error).__name__
        raise UserError(f"{path}: damaged, or of a version that cannot be read: {reason}; export it as text") from None


@contextmanager
def _with_suffix(path: Path, suffix: str) -> Iterator[Path]:
    """Yield a path of the file with a suffix, because fastnda recognizes the format by it."""
    if path.suffix.lower() == suffix:
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder) / f"capture{suffix}"
        link.symlink_to(path.resolve())
        yield link
