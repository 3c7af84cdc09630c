"""Boards and packs that are not there: what is at the other end of the line, for trying out, the demo and tests."""
