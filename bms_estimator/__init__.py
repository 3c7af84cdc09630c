"""Real-time Li-ion battery estimator: adaptive observer, parameters, SOC and stability margins.

The names in ``__all__`` are stable, see docs/reference/python.md; other modules may change.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from bms_estimator.version import __version__

if TYPE_CHECKING:
    from bms_estimator.calibration.automatic.calibrate import calibrate
    from bms_estimator.calibration.elements.identify import identify
    from bms_estimator.calibration.validate import validate
    from bms_estimator.estimator.estimator import Estimator, estimate
    from bms_estimator.model.cell import load_cell
    from bms_estimator.model.pack_model import write_cell
    from bms_estimator.pack.pack import Pack, new_pack
    from bms_estimator.settings.pack import Settings
    from bms_estimator.sources.captures.replay import load_capture

os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
"""numba highlights error messages with colorama, whose exit handler would block on an unread terminal."""

__all__ = [
    "Estimator",
    "Pack",
    "Settings",
    "__version__",
    "calibrate",
    "estimate",
    "identify",
    "load_capture",
    "load_cell",
    "new_pack",
    "validate",
    "write_cell",
]

_MODULES = {
    "Estimator": "estimator",
    "Pack": "pack.pack",
    "Settings": "settings.pack",
    "calibrate": "calibration.automatic.calibrate",
    "estimate": "estimator",
    "identify": "calibration.elements.identify",
    "load_capture": "sources.captures.replay",
    "load_cell": "model.cell",
    "new_pack": "pack.pack",
    "validate": "calibration.validate",
    "write_cell": "model.pack_model",
}
"""Module of each public name, imported on first use: importing numba alone would make ``bms-estimator --help`` too
slow."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
