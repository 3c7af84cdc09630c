"""Monotone cubic interpolation: bit for bit the results of scipy."""

import numpy as np
from hypothesis import given, strategies as st
from scipy.interpolate import PchipInterpolator

from bms_estimator.model.monotone_cubic import MonotoneCubic


@given(
    st.lists(
        st.tuples(st.floats(0.01, 1.0), st.sampled_from([-2.0, -1e-3, 0.0, 0.1, 0.3, 5.0])), min_size=2, max_size=9
    )
)
def test_values_and_slopes_are_those_of_scipy(steps):
    x, y = np.cumsum(steps, axis=0).T
    at = np.concatenate([np.linspace(x[0] - 0.5, x[-1] + 0.5, 101), x])
    reference, curve = PchipInterpolator(x, y), MonotoneCubic(x, y)
    assert np.array_equal(curve(at), reference(at))
    assert np.array_equal(curve.derivative(at), reference.derivative()(at))
