"""Ports for servers of tests."""

import itertools
import os
import socket

FIRST, END = 20_000, 32_768
"""Below those that the kernel gives to connections (``net.ipv4.ip_local_port_range``): one of these could be taken by a
connection between being found free and being listened on, or while a server that was killed is started again."""
_numbers = itertools.count(101 * os.getpid())  # tests run in several processes: each begins elsewhere


def free_port() -> int:
    """A port of the loopback that nobody listens on; never the same twice in a row."""
    for number in itertools.islice(_numbers, END - FIRST):
        port = FIRST + number % (END - FIRST)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise RuntimeError("no free port")
