"""Warnings about settings of the observer that violate conditions of the thesis.

Numbers in parentheses are equations of the thesis.
"""

from collections.abc import Iterator

from bms_estimator.estimator.stability_conditions import failed_conditions
from bms_estimator.model.cell import CellModel
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.observer import ObserverSettings

LAWS_WITH_BOUNDS = ("improved", "scheme-3")
"""Laws that adapt the parameters by (3.18). Lemma 4.1.1 applies to the bounds of (3.18) only."""
MAX_K_WITHOUT_GAIN = {"k2-cos": 0.0, "k-cos-sqrt": 0.0, "ln-cos-sqrt-ln": 1.0}
"""Adaptive gain k up to which a Nussbaum function N(k) is 0 [V^2 s]."""


def observer_warnings(observer: ObserverSettings, cell: PackModel) -> Iterator[str]:
    """Yield a warning for each condition of Lemma 4.1.1 that fails with (3.18), and one if N(k0) is 0.

    A fuel cell and the law ``learning`` use neither (3.18) nor N(k), so that they give no warning.
    """
    if not isinstance(cell, CellModel) or observer.law == "learning":
        return
    if observer.law in LAWS_WITH_BOUNDS:
        for condition in failed_conditions(cell):
            yield (
                f"{cell.cell.name}: condition {condition.name} of Lemma 4.1.1 fails: {condition.left:g} is not below "
                f"{condition.right:g}; a capacitance of the observer may become negative although the SOC is above its limit"
            )
    limit = MAX_K_WITHOUT_GAIN.get(observer.nussbaum)
    if limit is not None and observer.k0 <= limit:
        yield (
            f"observer.k0 = {observer.k0:g}: N(k) of {observer.nussbaum!r} is 0 up to k = {limit:g}, so that the observer does "
            f"not correct its voltage until k is larger; set observer.k0 above {limit:g}"
        )
