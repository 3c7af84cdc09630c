"""Forecast of the time to the cut-off voltage, of the available power and of the usable charge."""
