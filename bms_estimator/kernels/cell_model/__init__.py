"""Equations of the cell: Chen and Mora, RC ladder, fuel cell, current between samples, open loop."""
