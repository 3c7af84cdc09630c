"""Set-up of nats-server: configuration, JWT claims, credentials."""
