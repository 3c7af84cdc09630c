"""Pure numerical kernels (numba): no I/O, no clock, no Python objects.

numba's disk cache notices a change in a function's own file only, not in the files of the functions it calls, nor in
those of the constants it compiles in, and would go on running the old ones. So the cache lives in a folder named by the
content of all of them.
"""

import hashlib
import os
import tempfile
from pathlib import Path

import numba

_HERE = Path(__file__).parent
COMPILED_IN = (*sorted(_HERE.glob("*.py")), _HERE.parent / "model" / "suspect.py")
"""Files that compiled code is made of."""


def _cache_folder() -> Path:
    """Where compiled kernels go: NUMBA_CACHE_DIR, systemd's CacheDirectory, or the user's cache."""
    digest = hashlib.sha256()
    for source in COMPILED_IN:
        digest.update(source.read_bytes())
    home_cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    candidates = [
        os.environ.get("NUMBA_CACHE_DIR"),
        os.environ.get("CACHE_DIRECTORY"),
        str(Path(home_cache, "bms_estimator").expanduser()),
    ]
    for candidate in candidates:
        if candidate:
            folder = Path(candidate) / digest.hexdigest()[:16]
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError:
                continue
            if os.access(folder, os.W_OK):
                return folder
    return Path(tempfile.mkdtemp(prefix="bms_estimator-"))  # nowhere to keep them: compile at every start


numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]
