"""Slow fit: the pack's own OCV curve, capacity and resistances from weeks of history. It does no I/O."""
