"""Many packs on NATS JetStream."""
