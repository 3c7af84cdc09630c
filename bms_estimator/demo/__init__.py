"""A pack, a broker and a page in one command."""
