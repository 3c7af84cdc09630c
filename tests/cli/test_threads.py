"""Test of the number of threads that the command line gives to OpenBLAS."""

import os
import subprocess
import sys

PROGRAM = """
import sys
from bms_estimator.cli.main import main
try:
    main(["--version"])
except SystemExit:
    pass
import os
print(os.environ["OPENBLAS_NUM_THREADS"], "numpy" in sys.modules)
"""
"""Program that runs a short command."""


def test_commands_use_one_thread_for_linear_algebra() -> None:
    """OpenBLAS reads the variable when numpy is imported, so that it must be set before."""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "1 False"
