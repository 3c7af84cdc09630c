"""Typed values: samples, cell files, published payloads."""
