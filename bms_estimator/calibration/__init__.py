"""Cell files from captures."""
