"""Pure numerical kernels (numba): no I/O, no clock, no Python objects."""
