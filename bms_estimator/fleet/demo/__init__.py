"""A fleet in one terminal: server, simulated packs, workers and page."""
