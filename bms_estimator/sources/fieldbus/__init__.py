"""Samples from Modbus and CAN devices."""
