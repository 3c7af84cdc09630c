"""Samples from sensors that the Linux kernel reads."""
