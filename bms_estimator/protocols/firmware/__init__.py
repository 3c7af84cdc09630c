"""Frames of the project's own board: messages, framing, scaling, clock drift, decoder."""
