"""Samples from readings that others publish over MQTT."""
