"""Ports for servers of tests."""

import itertools
import os
import socket

FIRST, END = 20_000, 32_768
"""Range of ports. It lies below the ports of outgoing connections (``net.ipv4.ip_local_port_range``), one of which could
take a port before its server listens or while its server is restarted."""


def _part() -> range:
    """Return the ports of this worker. Other workers have other ports, so that they cannot take that of a restarted server."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    worker = (
        int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % workers
    )  # the number grows after a crash of a worker
    size = (END - FIRST) // workers
    return range(FIRST + worker * size, FIRST + (worker + 1) * size)


_ports = _part()
_numbers = itertools.count(101 * os.getpid())  # each run on a machine begins with another port


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
