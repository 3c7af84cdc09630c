"""MQTT client: connect, negotiate, reconnect, queue, subscribe. It does not depend on payloads."""
