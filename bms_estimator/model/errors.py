"""Errors that a user can fix: shown without a traceback, exit code 2."""


class UserError(Exception):
    """Invalid input, setting or device.

    The message says what is wrong, where, and what to do.
    """
