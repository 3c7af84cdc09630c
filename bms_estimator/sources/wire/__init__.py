"""The line's bytes in compiled code (numba): frames of the board, records of a raw capture. No I/O, no clock."""
