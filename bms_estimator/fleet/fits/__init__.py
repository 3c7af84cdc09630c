"""Fits of the packs' models to their histories, outside of the workers."""
