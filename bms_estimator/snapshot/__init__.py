"""From estimator and counters to what is published."""
