"""Check of the limit of open files, of which each connection of an edge needs one."""

import resource

import structlog

from bms_estimator.settings.fleet import FleetSettings

OTHER_FILES = 1000
"""Number of open files besides the connections of edges: files of the streams and connections of workers."""

log = structlog.get_logger(__name__)


def warn_of_open_file_limit(settings: FleetSettings) -> None:
    """Log a warning if the limit of open files is too small for a connection of each pack's edge.

    The hard limit counts, because nats-server raises its soft limit to it.
    """
    packs = sum(tenant.packs or settings.server.packs for tenant in settings.tenants_or_default.values())
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if limit != resource.RLIM_INFINITY and limit < packs + OTHER_FILES:
        log.warning(
            "the limit of open files is too small for all edges: increase LimitNOFILE of the systemd unit, or ulimit -n",
            packs=packs,
            limit=limit,
        )
