"""Simulated boards and packs at the other end of the line, for trials, the demo and tests."""
