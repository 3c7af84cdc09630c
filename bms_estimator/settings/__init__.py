"""Models of the settings files, one module for each section, with defaults and checks."""
