"""Saved estimator state: file, content, identity, restore."""
