"""Typed values: samples, cells, settings, estimates."""
