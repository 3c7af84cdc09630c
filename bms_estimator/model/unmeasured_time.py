"""Limits of the time between two samples over which a current counts as known."""

UNMEASURED_S = 60.0
"""Maximum step over which the current counts as measured [s]. For a slow source the maximum is ``MAX_STEP_PERIODS`` of its
periods, if these are longer."""
MAX_FLOW_S = 3600.0
"""Maximum time over which a current is integrated without a sample [s], so that one wrong time stamp cannot empty a
cell."""
