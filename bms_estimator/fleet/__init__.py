"""Many packs: edges send blocks of samples, workers estimate, a NATS server with JetStream stands between."""
