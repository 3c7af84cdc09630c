"""How long a test waits for what ought to come at once."""

LONG_S = 240.0
"""Only what hangs waits so long: a busy machine that compiles kernels on half a core takes minutes [s]."""
