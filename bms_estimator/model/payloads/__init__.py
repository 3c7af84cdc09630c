"""Published payloads of one pack, one file for each topic."""
