"""Worker whose process is killed by a block with a certain temperature, as by an error in native code. It is restarted at once."""

import os
import signal
import sys

from bms_estimator.cli.fleet.worker import worker  # noqa: F401 - imported before the fork, so that a restart is quick
from bms_estimator.cli.main import main
from bms_estimator.fleet.worker.block_processor import BlockProcessor
from bms_estimator.process.child_process import terminate_with_parent

TEMPERATURE_C = 66.6
"""Temperature of the samples of a lethal block."""
_step = BlockProcessor.step


def step_or_die(self: BlockProcessor, pack, block, *args):
    """Process a block; a lethal block kills the process."""
    if (block.samples["temperature_c"] == TEMPERATURE_C).all():
        os.kill(os.getpid(), signal.SIGKILL)
    return _step(self, pack, block, *args)


def run_until_it_survives() -> None:
    """Run the worker in child processes, until one of them ends by itself."""
    prepare_child = terminate_with_parent()
    while True:
        child = os.fork()
        if child == 0:
            prepare_child()
            main()
        signal.signal(signal.SIGTERM, lambda number, _, child=child: os.kill(child, number))
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            sys.exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    BlockProcessor.step = step_or_die
    run_until_it_survives()
