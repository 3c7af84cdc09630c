"""Captures without glitches, their rests, and plausibility checks."""
