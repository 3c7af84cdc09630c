"""One pack as a process: live loop, publisher, alarm monitor and hooks, requests."""
