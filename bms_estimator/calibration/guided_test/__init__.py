"""Guided tests that a user, or a relay, runs on a pack to calibrate its cells."""
