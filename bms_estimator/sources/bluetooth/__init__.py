"""Samples from BMS over Bluetooth LE."""
