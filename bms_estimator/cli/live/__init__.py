"""Commands on running devices and services."""
