"""Exports to InfluxDB and Prometheus."""
