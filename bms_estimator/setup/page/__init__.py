"""Setup as a web page."""
