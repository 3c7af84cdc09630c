"""Error that a user can fix. Commands print it without a traceback and exit with code 2."""


class UserError(Exception):
    """Invalid input, setting or device.

    The message contains the fault, its place, and a remedy.
    """
