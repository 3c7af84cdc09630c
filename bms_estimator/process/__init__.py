"""Parts of any long-running process: signals, tasks, systemd, instance lock, log set-up, disk thread."""
