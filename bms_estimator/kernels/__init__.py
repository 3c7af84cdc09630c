"""Compiled estimation code: no I/O, no clock, no Python objects."""
