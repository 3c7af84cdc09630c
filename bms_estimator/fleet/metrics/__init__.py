"""Prometheus metrics of a fleet."""
