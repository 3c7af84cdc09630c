"""Connection to NATS and its streams."""
