"""Resistances and capacitances from loads."""
