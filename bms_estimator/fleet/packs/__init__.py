"""Table of packs and their types."""
