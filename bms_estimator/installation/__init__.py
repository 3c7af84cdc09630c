"""Installation of the service on a machine with systemd: its files, its user, and its removal."""
