"""Sections of the settings file, one file each, with defaults and checks."""
