"""Alarms of one pack, evaluated from samples and estimates."""
