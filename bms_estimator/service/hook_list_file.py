"""File with the alarm hooks of the last start, so that a hook added since then acts on alarms that are already raised."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from threading import Thread

import structlog

from bms_estimator.process.private_file import UnsafeFileError, read_private, write_private
from bms_estimator.settings.alarms import AlarmHook

MAX_FILE_BYTES = 65_536
"""Maximum size of the file [bytes], about 900 hooks."""

REMOVE_S = 2.0
"""Maximum wait for a slow disk at the end of the service [s]."""
THREAD_NAME = "hook list"
"""Name of the thread that writes the file."""

log = structlog.get_logger(__name__)


class HookListFile:
    """File ``<pack>.hooks.json`` in the state folder with a hash of each hook, because a hook's arguments may hold secrets.

    Args:
        folder: The state folder.
        pack: The pack's name.
    """

    def __init__(self, folder: Path, pack: str) -> None:
        self._path = folder / f"{pack}.hooks.json"

    def replace(self, hooks: Sequence[AlarmHook]) -> list[AlarmHook]:
        """Return the hooks that the file does not contain, and write all hooks to it.

        Without a file, as after an upgrade, no hook counts as new; with a damaged one, every hook does.
        """
        hashes = [_hash(hook) for hook in hooks]
        known = self._load()
        if hashes != known:
            # in a thread of its own, so that a hung disk does not block the service
            Thread(target=self._save, args=(hashes,), name=THREAD_NAME, daemon=True).start()
        return [hook for hook, each in zip(hooks, hashes, strict=True) if known is not None and each not in known]

    def remove(self, hooks: Sequence[AlarmHook]) -> None:
        """Remove hooks, so that they count as new at the next start. Waits at most ``REMOVE_S`` for the disk."""
        removed = {_hash(hook) for hook in hooks}
        hashes = [str(each) for each in self._load() or () if each not in removed]
        thread = Thread(target=self._save, args=(hashes,), name=THREAD_NAME, daemon=True)
        thread.start()
        thread.join(REMOVE_S)

    def _save(self, hashes: Sequence[str]) -> None:
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_private(self._path, json.dumps(hashes).encode() + b"\n")
        except (OSError, UnsafeFileError) as error:
            log.warning("the list of hooks cannot be stored", file=str(self._path), reason=str(error))

    def _load(self) -> list[object] | None:
        """Return the content of the file; None without a file, and an empty list if it is damaged."""
        try:
            content = json.loads(read_private(self._path, MAX_FILE_BYTES))
        except FileNotFoundError:
            return None
        except (OSError, UnsafeFileError, ValueError, RecursionError) as error:
            log.warning("the list of hooks cannot be read", file=str(self._path), reason=str(error))
            return []
        return content if isinstance(content, list) else []


def _hash(hook: AlarmHook) -> str:
    """Return a hash of the settings that differ from the defaults, which a later version with more settings reproduces."""
    return hashlib.sha256(hook.model_dump_json(exclude_defaults=True).encode()).hexdigest()
