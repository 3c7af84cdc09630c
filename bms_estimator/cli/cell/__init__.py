"""Commands that make cell files."""
