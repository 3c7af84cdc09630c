"""Samples from a serial port, with a check of the board."""
