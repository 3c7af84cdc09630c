"""Cell files in the formats of other programs: PyBaMM and PyBOP, JSON, C."""
