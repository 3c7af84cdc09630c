"""Worker: partitions, checkpoints, block processing."""
