"""Compiled estimation kernels: no I/O, no clock, no Python objects."""
