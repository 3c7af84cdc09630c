"""Reports: the thesis recomputed beside the printed page."""
