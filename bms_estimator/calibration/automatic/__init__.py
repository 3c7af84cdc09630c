"""Calibration of a cell from captures without decisions by the user."""
