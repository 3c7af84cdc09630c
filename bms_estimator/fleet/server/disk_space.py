"""Disk space that the streams of a node need, and that its file system has."""

import shutil
from pathlib import Path

from bms_estimator.fleet.nats.stream_sizes import StreamSizes, stream_sizes
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.settings.fleet import FleetSettings, TenantSettings

GB = 1_000_000_000
"""Gigabyte [bytes]."""
ST_BLOCK_BYTES = 512
"""Unit of ``st_blocks`` [bytes]."""
USABLE_FRACTION = 0.75
"""Fraction of the available space that the streams may use without ``server.disk_gb``."""


def available_bytes(folder: Path) -> int:
    """Return the space that a folder of streams can use, including the space that it uses already [bytes]."""
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    stored = sum(_stored_bytes(file) for file in folder.rglob("*"))
    return shutil.disk_usage(existing).free + stored


def _stored_bytes(path: Path) -> int:
    """Return the space that a file takes on the disk [bytes]; 0 if it was removed meanwhile."""
    try:
        return path.stat().st_blocks * ST_BLOCK_BYTES
    except OSError:
        return 0


def sizes_of(settings: FleetSettings, tenant: TenantSettings) -> StreamSizes:
    """Return the sizes of a tenant's streams."""
    server = settings.server
    cells = server.cells if tenant.cells is None else tenant.cells
    outage_days = tenant.outage_days or server.outage_days
    return stream_sizes(tenant.packs or server.packs, outage_days, cells, server.block_s)


def check_disk_space(settings: FleetSettings, folder: Path, available: int, copies_per_node: float) -> None:
    """Check that the streams of all tenants fit.

    Args:
        settings: Settings of the fleet.
        folder: Folder of the streams, for the error.
        available: Space that the folder can use [bytes].
        copies_per_node: Mean number of copies of a stream on this node, at most 1.

    Raises:
        UserError: They are larger than ``server.disk_gb`` or the available space.
    """
    tenants = settings.tenants_or_default.values()
    needed = copies_per_node * sum(sizes_of(settings, tenant).total for tenant in tenants)
    limit_gb = settings.server.disk_gb
    if limit_gb is not None and needed > GB * limit_gb:
        raise UserError(
            f"server.disk_gb = {limit_gb:g}: the streams need {needed / GB:.1f} GB: "
            "increase disk_gb, or reduce packs or outage_days, of the server or of a tenant"
        )
    fraction = USABLE_FRACTION if limit_gb is None else 1.0
    if needed > fraction * available:
        raise TemporaryError(
            f"{folder}: the streams need {needed / GB:.1f} GB, but may use only {fraction * available / GB:.1f} GB, "
            f"{fraction:.0%} of the free space: choose a larger disk by --folder, "
            "or reduce packs or outage_days, of the server or of a tenant"
        )
