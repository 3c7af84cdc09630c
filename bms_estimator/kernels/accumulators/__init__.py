"""Sums over samples: charge and energy, publish window, hour, row of the fit history; certainty of the SOC."""
