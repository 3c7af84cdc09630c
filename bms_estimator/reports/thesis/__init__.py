"""Report that reproduces the tables and figures of the thesis."""
