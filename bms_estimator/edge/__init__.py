"""Sender of raw samples to a fleet's server, on the device: blocks, block store, NATS subjects."""
