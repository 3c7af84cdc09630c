"""Checkpoints of partitions: bytes, store on the server, and erasure of packs from them."""
