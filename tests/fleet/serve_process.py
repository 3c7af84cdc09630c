"""Process of ``fleet serve``."""

import signal
import subprocess
import threading
from pathlib import Path

from tests.command_line import PROGRAM
from tests.patience import LONG_S


class ServeProcess:
    """Process of ``fleet serve FILE``, which starts at once."""

    def __init__(self, file: Path, folder: Path) -> None:
        self._errors = folder.with_suffix(".err")
        with self._errors.open("w") as errors:
            self.process = subprocess.Popen(
                [PROGRAM, "fleet", "serve", file, "--folder", folder],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )

    def wait(self, text: str) -> None:
        """Wait for a line on stdout that contains ``text``."""
        assert self.process.stdout
        timeout = threading.Timer(LONG_S, self.process.kill)
        timeout.start()
        try:
            for line in self.process.stdout:
                if text in line:
                    return
        finally:
            timeout.cancel()
        raise AssertionError(f"ended without {text!r}: {self.errors()}")

    def errors(self) -> str:
        """Return its stderr."""
        return self._errors.read_text()

    def end(self) -> int:
        """Send SIGTERM and return the exit code."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(LONG_S)

    def close(self) -> None:
        """Kill the process if it still runs, and close its pipe."""
        self.process.kill()
        self.process.wait(LONG_S)
        assert self.process.stdout
        self.process.stdout.close()
