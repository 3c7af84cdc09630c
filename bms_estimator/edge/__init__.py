"""The fleet's end on the device: samples to blocks, block store, NATS subjects."""
