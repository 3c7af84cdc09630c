"""Protocols of BMS and meters, one file for each device."""
