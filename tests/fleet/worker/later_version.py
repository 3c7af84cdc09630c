"""Program of a later version: its checkpoints have another format, and the arguments are those of ``bms-estimator``.

The first argument is the newest format of this version. The migrations count the checkpoints that they convert.
"""

import sys
from collections.abc import Callable

from bms_estimator.fleet.worker.checkpoint import checkpoint_format
from bms_estimator.fleet.worker.checkpoint.checkpoint_format import Header, HeaderMigration

UPGRADED, DOWNGRADED = "upgraded", "downgraded"
"""Names of the counters of converted checkpoints."""


def count(header: Header, name: str) -> Header:
    """Return a header with a counter increased by one."""
    counters = header["counters"]
    return header | {"counters": counters | {name: counters.get(name, 0) + 1}}


def set_format(newest: int, set_attribute: Callable[[object, str, object], None] = setattr) -> None:
    """Set the newest format of this process."""
    migration = HeaderMigration(
        upgrade=lambda header: count(header, UPGRADED), downgrade=lambda header: count(header, DOWNGRADED)
    )
    set_attribute(checkpoint_format, "FORMAT", newest)
    set_attribute(checkpoint_format, "MIGRATION", migration)


if __name__ == "__main__":
    set_format(int(sys.argv.pop(1)))
    from bms_estimator.cli.main import main

    main()
