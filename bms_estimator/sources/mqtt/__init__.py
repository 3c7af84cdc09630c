"""Samples from readings that other programs publish over MQTT."""
