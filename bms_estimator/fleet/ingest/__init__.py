"""Intake of samples from an operator's telemetry platform, in place of edges."""
