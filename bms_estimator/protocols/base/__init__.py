"""Base classes of device protocols, readings and device clocks."""
