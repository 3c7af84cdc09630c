"""Creation of the streams of all tenants."""

from collections.abc import Callable

from nats.errors import Error as NatsError

from bms_estimator.fleet.nats.connection import close
from bms_estimator.fleet.nats.streams import NoAnswerError, make_streams
from bms_estimator.fleet.server import credentials
from bms_estimator.fleet.server.disk_space import sizes_of
from bms_estimator.fleet.server.jwt_claims import Role
from bms_estimator.fleet.server.local_client import connect
from bms_estimator.fleet.server.nats_config import Node
from bms_estimator.fleet.server.node_spec import NodeLocation, ServerSpec, node_config
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.settings.fleet import TenantSettings


async def make_all_streams(location: NodeLocation, spec: ServerSpec, report: Callable[[str], None]) -> None:
    """Create the streams of all tenants, if ``makes_streams`` is true for this node."""
    node = node_config(location, spec)
    if not makes_streams(location, node):
        report("ready; streams are made by the node that has the keys, the first")
        return
    for name, tenant in spec.settings.tenants_or_default.items():
        await _make_streams(location, spec, name, tenant)
        keys = f"; its keys: {location.keys / name}" if name else ""
        report(f"{f'tenant {name}: ' if name else ''}streams ready, {node.partitions} partitions{keys}")


def makes_streams(location: NodeLocation, node: Node) -> bool:
    """Return True if this node creates the streams: the node with the keys; without accounts, the first node."""
    return location.number == 1 if node.accounts is None else credentials.has_keys(location.keys)


async def _make_streams(location: NodeLocation, spec: ServerSpec, name: str, tenant: TenantSettings) -> None:
    node, server, sizes = node_config(location, spec), spec.settings.server, sizes_of(spec.settings, tenant)
    try:
        nc = await connect(node, credentials.credentials_file(location.keys, name, Role.ADMIN) if name else None)
    except TimeoutError:
        raise NoAnswerError(f"{node.nats}: the server does not accept the connection in time") from None
    except (NatsError, OSError) as error:
        raise TemporaryError(f"{node.nats}: the server rejects the connection: {error}") from None
    try:
        await make_streams(
            nc,
            partitions=node.partitions,
            replicas=location.replicas,
            raw_bytes=sizes.raw,
            raw_age_s=86_400.0 * (tenant.outage_days or server.outage_days),
            states_bytes=sizes.states,
            history_bytes=sizes.history,
            max_pack_blocks=sizes.pack_blocks,
        )
    except NoAnswerError:
        raise
    except UserError as error:
        hint = (
            ": reduce packs or outage_days, or increase disk_gb, of this tenant or of the server"
            if "insufficient" in str(error)
            else ""
        )
        raise type(error)(f"{f'tenant {name}: ' if name else ''}{error}{hint}") from None
    finally:
        await close(nc)
