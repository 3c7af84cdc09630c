"""Messages between workers and ``fleet fit``: rows of a history, requests for a fit, and results of a fit.

Rows and results are arrays in the format of ``numpy.savez_compressed``, so that a later version can recognize their layout.
"""

import io
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from bms_estimator.checkpoint.arrays_file import to_bytes
from bms_estimator.fleet.packs.pack_type import Digest
from bms_estimator.pack_model.bank_comparison import ComparedCell
from bms_estimator.pack_model.fit import PackFit
from bms_estimator.pack_model.saved import Arrays, curve_arrays, fit_from_arrays

COMPARED = np.dtype(
    [("soc", "f8"), ("filter_soc", "f8"), ("deviation_std", "f8"), ("mean", "f8", 2), ("covariance", "f8", (2, 2))],
    align=True,
)
"""Record of a ``ComparedCell``, with the same fields."""
MAGIC = b"BMSF"
"""First bytes of the result of a fit, different from those of a block."""


class RowsPosition(NamedTuple):
    """Position of rows in a history."""

    sequence: int
    """Stream sequence number of the block that completed the rows."""
    part: int
    """Index of the message among the messages of this block."""


class Rows(NamedTuple):
    """New rows of a history."""

    rows: NDArray[np.void]
    """Shape (n,), dtype HISTORY_ROW."""
    position: RowsPosition
    digest: Digest
    """``PackType.state_digest``; rows of another digest belong to another history."""


class FitRequest(BaseModel):
    """Request for a fit of all rows up to a position."""

    model_config = ConfigDict(frozen=True)

    sequence: Annotated[int, Field(ge=1)]
    """``RowsPosition.sequence`` of the last rows, which also identifies the request."""
    part: Annotated[int, Field(ge=0)]
    """``RowsPosition.part`` of the last rows."""

    @property
    def position(self) -> RowsPosition:
        """Position of the last rows."""
        return RowsPosition(self.sequence, self.part)


class FitResult(NamedTuple):
    """Result of a requested fit."""

    request: int
    """``FitRequest.sequence``."""
    is_fitted: bool
    """False: the history has too few new rows, or its currents are too uncertain."""
    fit: PackFit | None = None
    """The fit; None if it failed."""
    min_filter_std: float = 0.0
    """Minimum std of the filter's SOC at which the fit is adopted."""
    weakest: ComparedCell | None = None
    """Weakest cell of a bank according to the discharges since the previous fit; None: unknown."""


_WEAKEST = "weakest_"
"""Prefix of the arrays of ``FitResult.weakest``."""


def from_bytes(data: bytes) -> dict[str, NDArray[Any]]:
    """Decode the result of ``to_bytes``.

    Raises:
        ValueError: The bytes are damaged.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return dict(file)
    except Exception as error:  # damaged bytes may raise anything
        raise ValueError(f"damaged arrays ({type(error).__name__})") from error


def encode_rows(rows: Rows) -> bytes:
    """Encode rows."""
    return to_bytes(
        {"rows": rows.rows, "position": np.array(rows.position, np.uint64), "digest": np.array(rows.digest, np.uint64)}
    )


def position_of(arrays: Arrays) -> RowsPosition:
    """Return the position of decoded rows.

    Raises:
        KeyError: The arrays are not rows.
    """
    sequence, part = arrays["position"].tolist()
    return RowsPosition(sequence, part)


def digest_of(arrays: Arrays) -> Digest:
    """Return the digest of decoded rows.

    Raises:
        KeyError: The arrays are not rows.
    """
    first, second = arrays["digest"].tolist()
    return first, second


def is_fit(data: bytes) -> bool:
    """Return True if a message of the stream ``RAW`` is the result of a fit."""
    return data.startswith(MAGIC)


def encode_result(result: FitResult) -> bytes:
    """Encode the result of a fit."""
    fit = result.fit
    arrays = curve_arrays(fit) | {
        "request": np.uint64(result.request),
        "is_fitted": np.bool_(result.is_fitted),
        "is_exchanged": np.bool_(fit is not None and fit.is_exchanged),
        "min_filter_std": np.float64(result.min_filter_std),
    }
    if result.weakest is not None:
        arrays |= {f"{_WEAKEST}{name}": np.asarray(value) for name, value in vars(result.weakest).items()}
    return MAGIC + to_bytes(arrays)


def decode_result(data: bytes) -> FitResult:
    """Decode the result of ``encode_result``.

    Raises:
        ValueError: The bytes are not the result of a fit.
    """
    arrays = from_bytes(data.removeprefix(MAGIC))
    try:
        request, is_fitted, is_exchanged, min_filter_std = (
            arrays.pop(name).item() for name in ("request", "is_fitted", "is_exchanged", "min_filter_std")
        )
    except KeyError as error:
        raise ValueError(f"not the result of a fit: {error} is missing") from None
    weakest = _weakest({name: arrays.pop(name) for name in list(arrays) if name.startswith(_WEAKEST)})
    fit = fit_from_arrays(arrays)
    return FitResult(
        int(request),
        bool(is_fitted),
        None if fit is None else replace(fit, is_exchanged=bool(is_exchanged)),
        float(min_filter_std),
        weakest,
    )


def _weakest(arrays: Arrays) -> ComparedCell | None:
    """Return the decoded weakest cell; None without arrays.

    Raises:
        ValueError: An array is damaged.
    """
    if not arrays:
        return None
    values = [arrays.get(f"{_WEAKEST}{name}", np.zeros(0)) for name in COMPARED.names or ()]
    if [each.shape for each in values] != [COMPARED[name].shape for name in COMPARED.names or ()]:
        raise ValueError("the weakest cell is damaged")
    if not all(np.isfinite(each).all() for each in values):
        raise ValueError("the weakest cell has a value that is not finite")
    soc, filter_soc, deviation_std, mean, covariance = values
    return ComparedCell(float(soc), float(filter_soc), float(deviation_std), mean, covariance)
