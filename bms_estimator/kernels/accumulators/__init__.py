"""Sums over samples: charge and energy, publish window, hour."""
