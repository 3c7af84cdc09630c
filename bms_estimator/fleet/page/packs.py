"""Packs of a fleet for its page: live packs, distributions of SOC, and packs that need attention. No I/O.

The newest state of each pack is stored as bytes and decoded on request. Its ranked values are also stored in columns.
"""

import bisect
import math
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from bms_estimator.model.input_faults import InputFault

SILENT_S = 180.0
"""Time without a state after which a pack counts as silent [s]. A pack sends a block a minute."""
MAX_LISTED = 20
"""Maximum number of packs in a list."""
MAX_TYPES = 8
"""Maximum number of types that are shown. All further types are combined."""
MAX_TYPE_INDEX = 65_535
"""Largest value of column ``type``. All types beyond this number share this index."""
OTHER = "other types"
"""Name of all types beyond the ``MAX_TYPES`` most frequent ones."""
UNLISTED = "not in the table"
"""Name of the type of packs that are not in the table of packs."""
SOC_EDGES = np.linspace(0.0, 1.0, 21)
"""Histogram edges of the SOC."""
STD_EDGES = np.array([0.0, 0.01, 0.02, 0.04, 0.06, 0.08, 0.12, 0.16, 0.20, 0.30, 0.40, 0.60, math.inf]) / 2.0
"""Histogram edges of the standard deviation of SOC. The page shows twice these values."""

ROW = np.dtype(
    [
        ("heard_s", "f8"),  # time of the newest state on the page's clock; -inf: never
        ("soc", "f8"),  # 0..1; NaN: unknown, as in the other columns
        ("soc_std", "f8"),
        ("margin", "f8"),  # stability_margin
        ("suspects", "u2"),  # bits of InputFault in its last hour
        ("type", "u2"),  # index into the list of types
        ("listed", "?"),  # True if the pack is in the table of packs
    ]
)
_NEW_ROW = np.array([(-math.inf, math.nan, math.nan, math.nan, 0, 0, False)], dtype=ROW)
FIELDS = {"soc": "soc", "soc_std": "soc_std", "margin": "stability_margin"}
"""Fields of a state, by column of ``ROW``."""

Rows = NDArray[np.void]
Mask = NDArray[np.bool_]


class Concern(NamedTuple):
    """Criterion for packs that need attention."""

    column: str
    """Column of ``ROW``."""
    limit: float
    """Value below which a pack needs attention."""


CONCERNS = {
    "margin": Concern("margin", limit=0.05),
    "soc": Concern("soc", limit=0.1),
}
"""Criteria of live packs, by name. The smallest values are the worst."""
UNCERTAIN_STD = 0.05
"""Standard deviation of SOC above which a live pack counts as uncertain. This is no concern, because every new pack is uncertain
for hours."""


class FleetPacks:
    """State of all packs; times are on one monotonic clock [s]."""

    def __init__(self) -> None:
        self._indexes: dict[str, int] = {}
        self._names: list[str] = []
        self._sorted_names: list[str] = []
        self._rows = np.repeat(_NEW_ROW, 1024)  # grows by doubling
        self._states: list[bytes] = []
        self._parameters: dict[str, bytes] = {}
        self._types: dict[str, int] = {UNLISTED: 0}  # index of each type
        self.states = 0
        """Number of received states."""

    def set_type(self, name: str, type_name: str | None) -> None:
        """Set the type of a pack, such as ``lfp 16s2p``; None: the pack is not in the table of packs."""
        row = self._row(name)
        row["listed"] = type_name is not None
        row["type"] = self._types.setdefault(type_name or UNLISTED, min(len(self._types), MAX_TYPE_INDEX))

    def receive_state(self, name: str, state: bytes, now_s: float) -> None:
        """Store a pack's newest state."""
        self.states += 1
        values = _object(state)
        if values is None:
            return
        row = self._row(name)
        row["heard_s"] = now_s
        for column, field in FIELDS.items():
            row[column] = _number(values.get(field))
        self._states[self._indexes[name]] = state

    def receive_parameters(self, name: str, parameters: bytes) -> None:
        """Store a pack's newest parameters, compressed because they take some kilobytes."""
        self._row(name)
        self._parameters[name] = zlib.compress(parameters, 1)

    def receive_hour_summary(self, name: str, summary: bytes) -> None:
        """Store the input faults in the summary of a pack's hour."""
        values = _object(summary)
        suspects = values.get("suspects") if values else None
        if isinstance(suspects, int) and 0 <= suspects < 65_536:
            self._row(name)["suspects"] = suspects

    def find(self, prefix: str) -> list[str]:
        """Return the first ``MAX_LISTED`` names with this prefix, sorted."""
        if len(self._sorted_names) != len(self._names):
            self._sorted_names = sorted(self._names)
        first = bisect.bisect_left(self._sorted_names, prefix)
        return [name for name in self._sorted_names[first : first + MAX_LISTED] if name.startswith(prefix)]

    def details(self, name: str, now_s: float) -> dict[str, Any] | None:
        """Return the details of a pack; None if it is unknown."""
        index = self._indexes.get(name)
        if index is None:
            return None
        row, compressed = self._rows[index], self._parameters.get(name)
        return {
            "pack": name,
            "type": list(self._types)[row["type"]],
            "heard_s": _age_s(float(row["heard_s"]), now_s),
            "suspects": InputFault(int(row["suspects"])).text,
            "state": _object(self._states[index]),
            "parameters": _object(zlib.decompress(compressed)) if compressed else None,
        }

    def overview(self, now_s: float, since_s: float) -> dict[str, Any]:
        """Return an overview of the fleet.

        Args:
            now_s: Present time.
            since_s: Start of uninterrupted reception. Packs count as silent only ``SILENT_S`` after it.

        Returns:
            ``packs`` (counts), ``types`` (number and distribution of each), ``soc_std_edges`` (histogram edges; the last bin
            is open), ``concerns`` (number of packs and worst packs of each concern), ``attention_count`` (number of packs with
            any concern).
        """
        rows = self._rows[: len(self._names)]
        alive = rows["heard_s"] > now_s - SILENT_S
        counted = rows["listed"] | (rows["heard_s"] > -math.inf)
        silent = counted & ~alive & (now_s - since_s > SILENT_S)
        return {
            "packs": {
                "known": int(counted.sum()),
                "alive": int(alive.sum()),
                "silent": int(silent.sum()),
                "uncertain": int((alive & (rows["soc_std"] > UNCERTAIN_STD)).sum()),
            },
            "types": self._types_overview(rows, counted, alive),
            "soc_std_edges": STD_EDGES[:-1].tolist(),
            **self._concerns(rows, alive, silent, now_s),
        }

    def _row(self, name: str) -> Any:
        """Return the row of a pack; create it if it is missing."""
        index = self._indexes.get(name)
        if index is None:
            index = self._indexes[name] = len(self._names)
            if index == self._rows.size:
                self._rows = np.concatenate((self._rows, np.repeat(_NEW_ROW, index)))
            self._names.append(name)
            self._states.append(b"")
        return self._rows[index]

    def _types_overview(self, rows: Rows, counted: Mask, alive: Mask) -> list[dict[str, Any]]:
        counts = np.bincount(rows["type"][counted], minlength=len(self._types))
        names = list(self._types)
        by_size = sorted((-int(counts[index]), names[index], int(index)) for index in np.flatnonzero(counts))
        shown = [index for _, _, index in by_size[:MAX_TYPES]]
        masks: list[tuple[str, Mask]] = [(names[index], counted & (rows["type"] == index)) for index in shown]
        rest = counted & ~np.isin(rows["type"], shown)
        if rest.any():
            masks.append((OTHER, rest))
        return [{"type": name, "packs": int(mask.sum()), **_distribution(rows[mask & alive])} for name, mask in masks]

    def _concerns(self, rows: Rows, alive: Mask, silent: Mask, now_s: float) -> dict[str, Any]:
        """Return number and worst packs of each concern, and the number of packs with any."""
        concerns, attention = {}, silent | (rows["suspects"] > 0)
        for name, concern in CONCERNS.items():
            column = rows[concern.column]
            beyond = alive & (column < concern.limit)
            listed = [[self._names[i], value] for i, value in _extremes(column, alive & np.isfinite(column))]
            concerns[name] = {"count": int(beyond.sum()), "limit": concern.limit, "packs": listed}
            attention |= beyond
        suspected = _extremes(-np.bitwise_count(rows["suspects"]).astype("f8"), rows["suspects"] > 0)
        concerns["suspects"] = {
            "count": int(np.count_nonzero(rows["suspects"])),
            "packs": [[self._names[i], _fault_names(int(rows["suspects"][i]))] for i, _ in suspected],
        }
        concerns["silent"] = {
            "count": int(silent.sum()),
            "packs": [[self._names[i], _age_s(heard, now_s)] for i, heard in _extremes(rows["heard_s"], silent)],
        }
        return {"concerns": concerns, "attention_count": int(attention.sum())}


def _fault_names(suspects: int) -> str:
    """Return the names of the input faults in a bit mask."""
    return ", ".join((suspect.name or "").replace("_", " ").lower() for suspect in InputFault(suspects))


def _extremes(column: NDArray[np.float64], mask: Mask) -> list[tuple[int, float]]:
    """Return indexes and values of the ``MAX_LISTED`` smallest values where ``mask`` is true, ascending."""
    indexes = np.flatnonzero(mask)
    values = column[indexes]
    if indexes.size > MAX_LISTED:
        smallest = np.argpartition(values, MAX_LISTED)[:MAX_LISTED]
        indexes, values = indexes[smallest], values[smallest]
    order = np.argsort(values, kind="stable")
    return [(int(indexes[i]), float(values[i])) for i in order]


def _distribution(rows: Rows) -> dict[str, Any]:
    """Return counts, histograms and medians of some packs."""
    return {
        "alive": int(rows.size),
        "soc": _histogram(rows["soc"], SOC_EDGES),
        "soc_std": _histogram(rows["soc_std"], STD_EDGES),
        "soc_median": _median(rows["soc"]),
        "soc_std_median": _median(rows["soc_std"]),
    }


def _histogram(values: NDArray[np.float64], edges: NDArray[np.float64]) -> list[int]:
    """Count the values in each bin; values beyond the ends go to the first and last bin."""
    values = values[np.isfinite(values)]
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    return [int(n) for n in np.bincount(bins, minlength=edges.size - 1)]


def _median(values: NDArray[np.float64]) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else None


def _age_s(last_state_s: float, now_s: float) -> float | None:
    return now_s - last_state_s if last_state_s > -math.inf else None


def _number(value: Any) -> float:
    """Return a number unchanged; NaN if it is not a number."""
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_real and math.isfinite(value) else math.nan


def _object(data: bytes) -> dict[str, Any] | None:
    """Decode a JSON object; None if it is not one."""
    try:
        value = from_json(data, allow_inf_nan=False)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
