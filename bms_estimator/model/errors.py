"""Errors that a user can fix: shown without a traceback, exit code 2."""


class UserError(Exception):
    """Something outside the program is wrong: a file, a value, a device. The message says what, where and how to mend it."""
