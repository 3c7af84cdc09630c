"""Kernels of the forecast: the cell model run forward under randomly drawn loads."""
