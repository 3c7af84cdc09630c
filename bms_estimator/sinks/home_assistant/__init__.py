"""Home Assistant discovery and entity states."""
