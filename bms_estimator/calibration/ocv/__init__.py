"""Open-circuit voltage from rests, slow curves and tables."""
