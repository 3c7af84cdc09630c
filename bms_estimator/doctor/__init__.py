"""Examination of an installation: device, broker, service and machine, with a remedy for each fault."""
