"""Ports for servers of tests."""

import itertools
import os
import socket

FIRST, END = 20_000, 32_768
"""Below those that the kernel gives to connections (``net.ipv4.ip_local_port_range``): one of these could be taken by a
connection between being found free and being listened on, or while a server that was killed is started again."""


def _part() -> range:
    """Ports of this process: another worker of the same run would take those of a server that is killed and started again."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % workers  # after a crash they are numbered on
    size = (END - FIRST) // workers
    return range(FIRST + worker * size, FIRST + (worker + 1) * size)


_ports = _part()
_numbers = itertools.count(101 * os.getpid())  # several runs on one machine: each begins elsewhere


def free_port() -> int:
    """Return a free port on loopback; never the same twice in a row."""
    for number in itertools.islice(_numbers, len(_ports)):
        port = _ports[number % len(_ports)]
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise RuntimeError("no free port")
