"""SIGHUP: the settings are read anew; what can be changed while it runs is, what cannot is said by its key."""

import asyncio
import signal
from collections.abc import Callable, Sequence
from typing import Any

import structlog

from bms_estimator.model.errors import UserError
from bms_estimator.process.disk_thread import DiskThread
from bms_estimator.settings.pack import Settings

HUNG_S = 10.0
"""Settings that cannot be read in so long are left as they are [s]."""

log = structlog.get_logger(__name__)


class SettingsReload:
    """One pack's settings as they are in effect, and who takes another value of which.

    Args:
        settings: As it was started with.
        read: Reads them anew; may wait for a disk, and raise ``UserError``.

    Attributes:
        asked: Set to have them read.
    """

    def __init__(self, settings: Settings, read: Callable[[], Settings]) -> None:
        self._values, self._read = _flat(settings), read
        self._takers: dict[str, Callable[[Any], None]] = {}
        self._thread = DiskThread("settings")
        self.asked = asyncio.Event()

    def on_change(self, key: str, take: Callable[[Any], None]) -> None:
        """Have ``take`` called with another value of a setting, ``section.key``."""
        self._takers[key] = take

    async def reload(self) -> list[str]:
        """Read once. Returns the keys that have changed and need a restart."""
        said = "settings not reloaded, those before stay in effect"
        future = asyncio.get_running_loop().run_in_executor(self._thread, self._read)
        await asyncio.wait({future}, timeout=HUNG_S)
        if not future.done():
            future.cancel()
            self._thread = DiskThread("settings")  # the one before waits still
            log.warning(said, reason=f"nothing could be read in {HUNG_S:g} s: does the disk hang, or is it a pipe?")
            return []
        try:
            new = future.result()
        except UserError as error:
            log.warning(said, reason=str(error))
            return []
        values = _flat(new)
        changed = [key for key in values | self._values if values.get(key) != self._values.get(key)]
        taken, left = [], []
        for key in changed:
            if key in self._takers and key in values:
                self._takers[key](values[key])
                self._values[key] = values[key]
                taken.append(key)
            else:
                left.append(key)
        log.info("settings reloaded", changed=taken, **({"need a restart": left} if left else {}))
        return left


def _flat(settings: Settings) -> dict[str, Any]:
    """Values by ``section.key``; a section that is left out has none."""
    sections = settings.model_dump(by_alias=True).items()
    return {f"{section}.{key}": value for section, table in sections if table for key, value in table.items()}


def ask_all(packs: Sequence[SettingsReload]) -> None:
    """Have the settings of all packs of this process read."""
    for pack in packs:
        pack.asked.set()


def reload_on_hangup(packs: Sequence[SettingsReload]) -> None:
    """Have SIGHUP reload the settings of all packs of this process."""
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, ask_all, packs)
