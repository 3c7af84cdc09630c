"""Report that recomputes the thesis and compares the results with the printed ones."""
