"""Parts of the slow fit, of its anchors and of its hand-over, each with the changes that disable it."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from bms_estimator.estimator.estimator import Estimator
from bms_estimator.kernels.kalman_filter.anchors import EMPTY
from bms_estimator.kernels.kalman_filter.ocv_correction import NODE_CORRELATION
from bms_estimator.pack_model import equations, fit, handover, history, intervals, prediction, prior
from bms_estimator.pack_model.aging import Aging
from bms_estimator.pack_model.cell_curves import CellCurves
from bms_estimator.pack_model.equations import Equations
from bms_estimator.pack_model.intervals import Intervals, Links
from bms_estimator.pack_model.prediction import VoltageModel
from bms_estimator.pack_model.prior import Prior
from bms_estimator.pack_model.unknowns import Unknowns

Patch = tuple[ModuleType | type, str, object]
"""Module or class, the name of its attribute, and the attribute's value while the part is disabled."""
ZERO = 1e-6
"""Std of a fixed unknown, because a std of 0 has no inverse. ``1 / ZERO`` serves as a limit that is never reached."""
NO_AGING = Aging(use_std=0.0, time_std=0.0)
"""Aging that leaves the quantity as it is."""
FEW_ROWS = 400
"""Number of rows of a short history. Two weeks have fewer rows than the slow fit allows (``MAX_ROWS``), so that
old rows are merged only with this lower limit."""
SHORT_HISTORY: tuple[Patch, ...] = ((history, "MAX_ROWS", FEW_ROWS), (history, "OLD_S", 0.5 * history.DAY_S))
"""Changes for a short history. It ends within two days, before the rows are as old as those that the slow fit merges (``OLD_S``)."""


@dataclass(frozen=True)
class Part:
    """Changes that disable one part."""

    patches: tuple[Patch, ...] = ()
    """Attributes of modules and classes."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Settings of the filter (dtype EKF_SETTINGS). The slow fit does not use them."""
    anchors: Mapping[str, float] = field(default_factory=dict)
    """Settings of the anchors (dtype ANCHOR_SETTINGS)."""
    gains: Mapping[str, float] = field(default_factory=dict)
    """Gain errors of the source that the owner declares (``Sampling``)."""
    has_slow_fit: bool = True
    """False: only the filter runs."""

    @contextmanager
    def disabled(self) -> Iterator[None]:
        """Disable the part within the context."""
        with pytest.MonkeyPatch.context() as patch:
            for owner, name, value in self.patches:
                patch.setattr(owner, name, value)
            yield

    def change_settings(self, estimator: Estimator) -> None:
        """Change the settings of an estimator that was created in the context of ``disabled``."""
        for record, values in (("filter", self.settings), ("anchors", self.anchors)):
            for name, value in values.items():
                estimator.settings_record[0][record][name] = value


def after_init(owner: type, change: Callable[..., None]) -> Patch:
    """Return a patch that calls ``change`` with the object and its arguments after ``__init__`` of a class."""
    original: Callable[..., None] = owner.__init__

    def changed(self: Any, *arguments: Any) -> None:
        original(self, *arguments)
        change(self, *arguments)

    return owner, "__init__", changed


def count_direction_as_noise(model: VoltageModel, *_: object) -> None:
    """Replace the error that recurs at each pass in one direction by independent noise of the same variance."""
    model.variance_v2 = model.variance_v2 + model.rows["direction_v"] ** 2
    model.rows["direction_v"] = 0.0


def fix_hysteresis(*parts: float | None) -> Patch:
    """Return a patch that fixes the factors on the fast and the slow part of the hysteresis; None: unknown, with a mean of 1."""

    def change(p: Prior, _cell: CellCurves, _intervals: Intervals, u: Unknowns) -> None:
        for at, value in zip(range(u.hysteresis.start, u.hysteresis.stop), parts, strict=True):
            p.mean[at] = 1.0 if value is None else value
            if value is not None:
                p.precision[at, at] = 1.0 / ZERO**2

    return after_init(Prior, change)


def set_in_curves(**values: float) -> Patch:
    """Return a patch that sets attributes of the slow fit's ``CellCurves``."""

    def change(cell: CellCurves, *_: object) -> None:
        for name, value in values.items():
            getattr(cell, name)  # raises an error if there is no such attribute
            setattr(cell, name, value)

    return after_init(CellCurves, change)


def count_each_full(e: Equations, *_: object) -> None:
    """Give each end of charge an independent error with the std of the anchor."""
    e.known_std = np.where(e.is_full, e.rows["reference_std"][e.known_rows], e.known_std)


def count_each_empty(e: Equations, *_: object) -> None:
    """Give each end of discharge an independent error."""
    is_empty = e.rows["reference_kind"][e.known_rows] == EMPTY
    e.known_std = np.where(is_empty, e.rows["reference_std"][e.known_rows], e.known_std)


def links_without_gaps(cell: CellCurves, history_intervals: Intervals) -> Links:
    """Return the links of intervals that no gap separates."""
    links = ORIGINAL_LINKS(cell, history_intervals)
    is_kept = ~history_intervals.is_new_segment[links.interval]
    return Links(*(getattr(links, name)[is_kept] for name in Links.__dataclass_fields__))


def rough_derivatives(model: VoltageModel, x: Any, p: Any, *, use_file_slope: bool) -> Any:
    """Return the derivatives by the SOC with the slope of the fitted curve."""
    return ORIGINAL_DERIVATIVES(model, x, p, use_file_slope=False)


ORIGINAL_LINKS = Links.of
ORIGINAL_DERIVATIVES = VoltageModel.derivatives

NOTHING = "nothing"
PARTS: dict[str, Part] = {
    NOTHING: Part(),
    "slow fit": Part(has_slow_fit=False),
    "error of the OCV": Part(((prior, "curve_covariance", lambda _, soc: ZERO**2 * np.eye(soc.size)),)),
    "shift of the OCV along SOC": Part(((prior, "MAX_SLIP_FRACTION", 0.0),)),
    "direction-dependent error (independent noise instead)": Part(
        (after_init(VoltageModel, count_direction_as_noise),)
    ),
    "error of R over SOC": Part(((prior, "SHAPE_STD", ZERO),)),
    "error of R over temperature": Part(((prior, "ARRHENIUS_STD", ZERO),)),
    "temperature coefficient of the OCV": Part(((prior, "ENTROPY_STD_V", ZERO * prior.ENTROPY_STD_V),)),
    "two parts of the hysteresis (one instead)": Part((fix_hysteresis(0.0, None),)),
    "learned hysteresis": Part((fix_hysteresis(0.5, 0.5),)),
    "hysteresis": Part((fix_hysteresis(0.0, 0.0),)),
    "unknown hysteresis at the start of a segment": Part(((prior, "HYST_STD", ZERO),)),
    "unknown load at the start of a segment": Part(((prediction, "START_LOAD_C", 0.0),)),
    "offset": Part((set_in_curves(offset_std_a=0.0),)),
    "drift of the offset": Part((set_in_curves(offset_s=1e12),)),
    "capacity": Part((set_in_curves(capacity_std=0.0), (prior, "CAPACITY", NO_AGING))),
    "drift of the capacity": Part(((prior, "CAPACITY", NO_AGING),)),
    "full anchors": Part(anchors={"full_v": np.inf}),
    "full anchors count once": Part(
        (
            (prior, "full_std", lambda _: ZERO),
            after_init(Equations, count_each_full),
        )
    ),
    "empty anchors": Part(anchors={"cutoff_v": -np.inf}),
    "empty anchors count once": Part((after_init(Equations, count_each_empty),)),
    "std of the surface SOC under load": Part(((prediction, "SURFACE_STD_SOC", 0.0),)),
    "smaller weight of SOC zones without a fit": Part(((equations, "FITTED_RMS", 1.0 / ZERO),)),
    "Huber": Part(((equations, "HUBER", 1.0 / ZERO),)),
    "larger error at the knee near empty": Part(((prediction, "KNEE_STD_SOC", 0.0),)),
    "end of an interval by the std of its charge": Part(((intervals, "COUNTED_STD", np.inf),)),
    "links across gaps": Part(((Links, "of", links_without_gaps),)),
    "charge hidden in a gap, in the slow fit": Part((set_in_curves(event_probability=0.0),)),
    "level of a plateau, in the filter": Part(settings={"node_correlation": NODE_CORRELATION}),
    "any SOC after a gap, in the filter": Part(settings={"event_probability": 0.0}),
    "several starts": Part(((fit, "STARTS", fit.STARTS[:1]),)),
    "weights of minima with a small exponent": Part(((fit, "LIKELIHOOD_EXPONENT", 1.0),)),
    "secant over a row as slope": Part(((VoltageModel, "_slope_v", lambda model, _, z: model.cell.slope(z)),)),
    "slope of the file in the covariance": Part(((VoltageModel, "derivatives", rough_derivatives),)),
    "minimum std after a fit": Part(((handover, "MIN_SOC_STD_FRACTION", 0.0),)),
    "std of the voltage gain": Part(gains={"voltage_gain_std": 0.0}),
    "std of the current gain": Part(gains={"current_gain_std": 0.0}),
    f"rows beyond {FEW_ROWS}, old ones merged": Part(SHORT_HISTORY),
    f"rows beyond {FEW_ROWS}, old ones dropped": Part(
        (*SHORT_HISTORY, (history, "thin_old_rows", lambda rows, _: rows))
    ),
}
"""Changes that disable each part, by its name in the table."""
