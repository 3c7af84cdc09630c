"""Kernel warm-up before the first sample, which prevents compilation and long garbage collections later."""

import gc

from bms_estimator.kernels.cell_model.rc_ladder import resistances
from bms_estimator.kernels.kalman_filter.input_checks import store_last_good_state
from bms_estimator.kernels.kalman_filter.mixture import clear_hypothesis, mixture_moments
from bms_estimator.kernels.least_squares import backward_substitution, eliminate_sparse, forward_substitution
from bms_estimator.kernels.pack_voltage import voltage_derivatives, voltages
from bms_estimator.service.kernel_warm_up import load_kernels


def test_the_garbage_collector_skips_the_kernels() -> None:
    load_kernels()
    assert gc.get_freeze_count() > 50_000  # numba alone has more objects
    assert len(gc.get_objects()) < gc.get_freeze_count()


def test_the_kernels_of_the_adoption_of_a_fit_are_loaded() -> None:
    load_kernels()
    for kernel in (resistances, store_last_good_state, clear_hypothesis, mixture_moments):
        assert kernel.signatures, kernel.__name__


def test_the_kernels_of_a_fit_are_loaded() -> None:
    load_kernels()
    for kernel in (voltages, voltage_derivatives, eliminate_sparse, forward_substitution, backward_substitution):
        assert kernel.signatures, kernel.__name__
