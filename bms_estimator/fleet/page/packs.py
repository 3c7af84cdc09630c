"""All packs of a fleet as its page shows them: which are alive, their distribution, which need attention. Pure.

The newest state of each pack is stored as bytes, and the ranked values in columns; the rest is decoded on request.
"""

import bisect
import math
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from bms_estimator.model.input_faults import InputFault

ALIVE_S = 180.0
"""Time without a block after which a pack counts as silent [s]; a pack sends a block a minute."""
LISTED = 20
"""Packs of a list, at most."""
MAX_TYPES = 8
"""Maximum number of types shown; the rarer ones are combined."""
OTHER, UNLISTED = "other types", "not in the table"
SOC_EDGES = np.linspace(0.0, 1.0, 21)
STD_EDGES = np.array([0.0, 0.01, 0.02, 0.04, 0.06, 0.08, 0.12, 0.16, 0.20, 0.30, 0.40, 0.60, math.inf]) / 2.0
"""Edges of the bins. The page shows two standard deviations."""

ROW = np.dtype(
    [
        ("heard_s", "f8"),  # time of the newest state on the page's clock; -inf: never
        ("soc", "f8"),  # 0..1; nan: not known, as in all
        ("soc_std", "f8"),
        ("margin", "f8"),  # stability_margin
        ("suspects", "u2"),  # bits of Suspect, of its last hour
        ("type", "u2"),  # place in the list of types
        ("listed", "?"),  # in the fleet's table
    ]
)
_NEW = np.array([(-math.inf, math.nan, math.nan, math.nan, 0, 0, False)], dtype=ROW)
FIELDS = {"soc": "soc", "soc_std": "soc_std", "margin": "stability_margin"}
"""Fields of a state by the columns of a row."""

Rows = NDArray[np.void]
Mask = NDArray[np.bool_]


class Concern(NamedTuple):
    """Why a pack needs attention."""

    column: str
    """Column of the ranking."""
    falls: bool
    """The smallest first."""
    limit: float
    """Limit beyond which a pack is counted."""


CONCERNS = {
    "margin": Concern("margin", falls=True, limit=0.05),
    "soc": Concern("soc", falls=True, limit=0.1),
    "uncertain": Concern("soc_std", falls=False, limit=0.05),
}
"""Concerns about live packs."""


class FleetPacks:
    """State of all packs; times are on one monotonic clock [s]."""

    def __init__(self) -> None:
        self._places: dict[str, int] = {}
        self._names: list[str] = []
        self._sorted: list[str] = []
        self._rows = np.repeat(_NEW, 1024)
        self._states: list[bytes] = []
        self._parameters: dict[str, bytes] = {}
        self._types: dict[str, int] = {UNLISTED: 0}
        self.states, self.damaged = 0, 0
        """Received so far; those that were no JSON object."""

    def list_pack(self, name: str, kind: str | None) -> None:
        """Set the type of a pack in the fleet's table, such as ``lfp 16s2p``; None removes it."""
        row = self._row(name)
        row["listed"] = kind is not None
        row["type"] = self._types.setdefault(kind or UNLISTED, min(len(self._types), 65_535))

    def receive_state(self, name: str, state: bytes, now_s: float) -> None:
        """Take what a pack has published."""
        self.states += 1
        values = _object(state)
        if values is None:
            self.damaged += 1
            return
        row = self._row(name)
        row["heard_s"] = now_s
        for column, field in FIELDS.items():
            row[column] = _number(values.get(field))
        self._states[self._places[name]] = state

    def receive_parameters(self, name: str, parameters: bytes) -> None:
        """Take what a pack has published; it is stored compressed, since it has some kilobytes."""
        self._row(name)
        self._parameters[name] = zlib.compress(parameters, 1)

    def receive_hour(self, name: str, hour: bytes) -> None:
        """Take the summary of a pack's hour."""
        values = _object(hour)
        suspects = values.get("suspects") if values else None
        if isinstance(suspects, int) and 0 <= suspects < 65_536:
            self._row(name)["suspects"] = suspects

    def find(self, prefix: str) -> list[str]:
        """Return the first names with this prefix, in order."""
        if len(self._sorted) != len(self._names):
            self._sorted = sorted(self._names)
        first = bisect.bisect_left(self._sorted, prefix)
        return [name for name in self._sorted[first : first + LISTED] if name.startswith(prefix)]

    def one(self, name: str, now_s: float) -> dict[str, Any] | None:
        """All that is known of a pack; None: it is not known."""
        place = self._places.get(name)
        if place is None:
            return None
        row, packed = self._rows[place], self._parameters.get(name)
        return {
            "pack": name,
            "type": list(self._types)[row["type"]],
            "heard_s": _ago(float(row["heard_s"]), now_s),
            "suspects": InputFault(int(row["suspects"])).text,
            "state": _object(self._states[place]),
            "parameters": _object(zlib.decompress(packed)) if packed else None,
        }

    def picture(self, now_s: float, since_s: float) -> dict[str, Any]:
        """Return an overview of the fleet.

        Args:
            now_s: The clock.
            since_s: Time since which states are received without a break; a pack that was last seen before may not be
                silent.

        Returns:
            ``packs`` (counts), ``types`` (of each: how many, and how they are spread), ``soc_std_edges`` (of bins, the last is
            open), ``concerns`` (of each kind: how many
            packs, and those that are worst), ``attention`` (how many packs are in any).
        """
        rows = self._rows[: len(self._names)]
        alive = rows["heard_s"] > now_s - ALIVE_S
        known = rows["listed"] | (rows["heard_s"] > -math.inf)
        silent = known & ~alive & (now_s - since_s > ALIVE_S)
        return {
            "packs": {
                "known": int(known.sum()),
                "alive": int(alive.sum()),
                "silent": int(silent.sum()),
                "unlisted": int((known & ~rows["listed"]).sum()),
            },
            "types": self._spreads(rows, known, alive),
            "soc_std_edges": STD_EDGES[:-1].tolist(),
            **self._concerns(rows, alive, silent, now_s),
        }

    def _row(self, name: str) -> Any:
        """Return the row of a pack, created at its first message."""
        place = self._places.get(name)
        if place is None:
            place = self._places[name] = len(self._names)
            if place == self._rows.size:
                self._rows = np.concatenate((self._rows, np.repeat(_NEW, place)))
            self._names.append(name)
            self._states.append(b"")
        return self._rows[place]

    def _spreads(self, rows: Rows, known: Mask, alive: Mask) -> list[dict[str, Any]]:
        counts = np.bincount(rows["type"][known], minlength=len(self._types))
        names = list(self._types)
        found = sorted((-int(counts[place]), names[place], int(place)) for place in np.flatnonzero(counts))
        often = [place for _, _, place in found[:MAX_TYPES]]
        masks: list[tuple[str, Mask]] = [(names[place], known & (rows["type"] == place)) for place in often]
        rest = known & ~np.isin(rows["type"], often)
        if rest.any():
            masks.append((OTHER, rest))
        return [{"type": name, "packs": int(mask.sum()), **_spread(rows[mask & alive])} for name, mask in masks]

    def _concerns(self, rows: Rows, alive: Mask, silent: Mask, now_s: float) -> dict[str, Any]:
        """Each kind, and how many packs there are in any."""
        found, attention = {}, silent | (rows["suspects"] > 0)
        for name, concern in CONCERNS.items():
            sign = 1.0 if concern.falls else -1.0
            column = sign * rows[concern.column]
            beyond = alive & (column < sign * concern.limit)
            listed = [[self._names[i], sign * value] for i, value in _extremes(column, alive & np.isfinite(column))]
            found[name] = {"count": int(beyond.sum()), "limit": concern.limit, "packs": listed}
            attention |= beyond
        suspected = _extremes(-np.bitwise_count(rows["suspects"]).astype("f8"), rows["suspects"] > 0)
        found["suspects"] = {
            "count": int(np.count_nonzero(rows["suspects"])),
            "packs": [[self._names[i], _named(int(rows["suspects"][i]))] for i, _ in suspected],
        }
        found["silent"] = {
            "count": int(silent.sum()),
            "packs": [[self._names[i], _ago(heard, now_s)] for i, heard in _extremes(rows["heard_s"], silent)],
        }
        return {"concerns": found, "attention": int(attention.sum())}


def _named(suspects: int) -> str:
    """Describe each in a word or two."""
    return ", ".join((suspect.name or "").replace("_", " ").lower() for suspect in InputFault(suspects))


def _extremes(column: NDArray[np.float64], mask: Mask) -> list[tuple[int, float]]:
    """Places and values of the smallest where ``mask`` is, in order."""
    places = np.flatnonzero(mask)
    values = column[places]
    if places.size > LISTED:
        few = np.argpartition(values, LISTED)[:LISTED]
        places, values = places[few], values[few]
    order = np.argsort(values, kind="stable")
    return [(int(places[i]), float(values[i])) for i in order]


def _spread(rows: Rows) -> dict[str, Any]:
    """Return the spread over live packs."""
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


def _ago(heard_s: float, now_s: float) -> float | None:
    return now_s - heard_s if heard_s > -math.inf else None


def _number(value: Any) -> float:
    """Return a number unchanged; NaN if it is not a number."""
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if real and math.isfinite(value) else math.nan


def _object(data: bytes) -> dict[str, Any] | None:
    """Decode a JSON object; None if it is not one."""
    try:
        value = from_json(data, allow_inf_nan=False)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None
