"""Device protocols: bytes to readings and samples, no I/O."""
