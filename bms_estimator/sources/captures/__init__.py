"""Samples from recorded files: raw captures and tables."""
