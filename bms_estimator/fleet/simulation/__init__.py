"""Simulated load of a fleet."""
