"""Ports for servers of tests."""

import itertools
import os
import socket

FIRST, END = 20_000, 32_768
"""Range of ports, below those of outgoing connections (``net.ipv4.ip_local_port_range``).

An outgoing connection could otherwise occupy a port before its server listens or while its server is restarted.
"""


def _ports_of_worker() -> range:
    """Return the ports of this worker. No other worker has them, so that none can take the port of a stopped server."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    # After a crash of a worker, the next worker has a number above the count.
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % workers
    size = (END - FIRST) // workers
    return range(FIRST + worker * size, FIRST + (worker + 1) * size)


_ports = _ports_of_worker()
_numbers = itertools.count(101 * os.getpid())  # concurrent runs on a machine begin with different ports


def free_port() -> int:
    """Return a free port on the loopback interface. Successive calls return different ports."""
    for number in itertools.islice(_numbers, len(_ports)):
        port = _ports[number % len(_ports)]
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise RuntimeError("no free port")
