"""The demo: a broker and a board on one machine."""
