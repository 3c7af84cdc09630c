"""Alarms of a pack: their states, the values that they compare, and the loss of measured quantities."""
