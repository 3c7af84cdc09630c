"""Kernel warm-up before the first sample, which prevents long garbage collections later."""

import gc

from bms_estimator.service.kernel_warm_up import load_kernels


def test_the_garbage_collector_skips_the_kernels() -> None:
    load_kernels()
    assert gc.get_freeze_count() > 50_000  # numba alone has more objects
    assert len(gc.get_objects()) < gc.get_freeze_count()
