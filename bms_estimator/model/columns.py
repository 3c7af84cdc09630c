"""Columns of a capture or of its estimates by name. Names contain the unit."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Columns(Mapping[str, NDArray[Any]]):
    """Columns of equal length, a mapping from name to array.

    Attributes:
        rows: Shape (n,), structured array with the columns as fields, as in ``Estimator.run``.
        name: Name of the capture for messages.
        note: Text that says what was guessed about the file of the capture; empty if nothing was.
        warning: Contradiction in the file that the user should resolve; empty without one.
    """

    rows: NDArray[np.void]
    name: str = ""
    note: str = ""
    warning: str = ""

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.names:
            raise KeyError(f"{name}: no such column; there are {', '.join(self.names)}")
        column: NDArray[Any] = self.rows[name]
        return column

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return self.rows.dtype.names or ()

    def to_pandas(self) -> Any:
        """Return the columns as a ``pandas.DataFrame``; needs pandas."""
        import pandas as pd  # noqa: PLC0415 - optional

        return pd.DataFrame(self.rows)
