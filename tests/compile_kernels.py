"""Compiles the kernels that most tests and programs need, once, before workers start that would each do it."""

from bms_estimator.model.cell import load_cell
from bms_estimator.model.settings import Settings
from bms_estimator.service.live import new_estimator
from bms_estimator.sources.frames import FrameDecoder


def compile_kernels() -> None:
    """Those of the service."""
    new_estimator(Settings(), load_cell("chen_mora"))
    FrameDecoder()


if __name__ == "__main__":
    compile_kernels()
