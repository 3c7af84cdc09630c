"""Errors that a user can fix. Commands print them without a traceback."""


class UserError(Exception):
    """Invalid input, setting or device. Commands exit with code 2, after which systemd does not restart a service.

    The message contains the fault, its place, and a remedy.
    """


class TemporaryError(UserError):
    """Fault of the environment that may end without a change of the settings, such as a folder that is not mounted yet.

    Commands exit with code 75, after which systemd restarts a service.
    """
