"""Sinks of payloads: MQTT, terminal, exports, trace files."""
