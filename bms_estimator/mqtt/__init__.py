"""MQTT client: connect, negotiate, reconnect, queue, subscribe. It knows no payload."""
