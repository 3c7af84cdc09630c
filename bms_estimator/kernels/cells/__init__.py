"""Estimators of single cells: deviations of SOC, capacity, resistance and self-discharge from the other cells of the pack."""
