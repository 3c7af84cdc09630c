"""Runs a function as another user, because root may open and write everything."""

import os
import pickle
import warnings
from collections.abc import Callable
from typing import TypeVar

NOBODY = 65534
"""User and group without permissions."""
T = TypeVar("T")


def as_nobody(function: Callable[[], T]) -> T:
    """Run a function in a child process of the user ``nobody``, and return its result. Without root, it runs as this user."""
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the child uses none of the parent's threads
        child = os.fork()
    if child == 0:
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            os.write(writer, pickle.dumps(function()))
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as results:
        result = results.read()
    os.waitpid(child, 0)
    assert result, "the function raised an exception; its traceback is on stderr"
    return pickle.loads(result)
