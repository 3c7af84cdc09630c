"""Claims of an operator, its tenants' accounts and their users. A server checks them by their signatures.

A claim is a JSON Web Token with the fields of https://github.com/nats-io/jwt, version 2, signed with an ed25519 key in
the encoding of https://github.com/nats-io/nkeys. The permissions of a role are in the account's claims, beside
the public key that signs its users. A token contains only an identity, so the server needs no list of tokens.
"""

import base64
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from typing import Any

import nkeys

from bms_estimator.fleet.nats.streams import MAX_BLOCK_BYTES

ACCOUNT = nkeys.PREFIX_BYTE_ACCOUNT
"""Prefix of the keys of accounts."""
OPERATOR = nkeys.PREFIX_BYTE_OPERATOR
"""Prefix of the key of the operator."""
USER = nkeys.PREFIX_BYTE_USER
"""Prefix of the keys of users."""
_VERSION = 2
"""Version of the claims' format."""
_UNLIMITED = -1
"""Value of a limit that means unlimited."""


class Role(Enum):
    """Role of a tenant's user."""

    EDGE = "edge"
    """Sends the blocks of one pack and receives the replies to it."""
    DASHBOARD = "dashboard"
    """Reads estimates over MQTT."""
    READER = "reader"
    """Reads all data: fleet page, queries, captures."""
    WORKER = "worker"
    """Processes blocks and publishes estimates."""
    SENDER = "sender"
    """Telemetry platform that sends batches over NATS."""
    MQTT_SENDER = "mqtt-sender"
    """Telemetry platform that sends batches over MQTT."""
    INGEST = "ingest"
    """Receives batches, and sends blocks for all packs (``fleet ingest``)."""
    ADMIN = "admin"
    """Creates streams and writes the table of packs."""


BEARER_ROLES = (Role.EDGE, Role.DASHBOARD, Role.MQTT_SENDER)
"""Roles with bearer tokens. They connect by MQTT, which has no challenge to sign."""

_READER_PUBLISH = (
    "$JS.API.INFO",
    "$JS.API.STREAM.INFO.*",
    "$JS.API.STREAM.NAMES",
    "$JS.API.STREAM.LIST",
    "$JS.API.STREAM.MSG.GET.*",
    "$JS.API.DIRECT.GET.>",
    "$JS.API.CONSUMER.>",
    "$JS.ACK.>",
    "$JS.FC.>",
)
_WORKER_PUBLISH = (
    *_READER_PUBLISH,
    "$JS.API.STREAM.PURGE.OBJ_states",
    "$KV.checkpoints.>",
    "$KV.packs.*",
    "$KV.cells.*",
    "$O.states.>",
    "edge.*.awaits",
    "bms.>",
    "hours.*",
    "dead.*.*",
    "table.*",
    "history.*",
    "fits.*",  # requests for fits
    "fit.*",  # results of fits
    "fleet.>",
    "_INBOX.>",
)
_INGEST_PUBLISH = (
    "$JS.API.STREAM.INFO.*",
    "$JS.API.DIRECT.GET.>",
    "$JS.API.STREAM.CREATE.TELEMETRY",
    "$JS.API.STREAM.UPDATE.TELEMETRY",
    "$JS.API.STREAM.PURGE.TELEMETRY",
    "$JS.API.STREAM.DELETE.TELEMETRY",
    "raw.*",
    "ingest.*",
    "dead.*.*",
    "fleet.ingest",
)
_SUBSCRIBE = ("_INBOX.>", "bms.>", "fleet.>")
_ALLOWED: dict[Role, tuple[tuple[str, ...], tuple[str, ...]]] = {
    # Subjects to publish, and subjects to subscribe. {{name()}} is the user's name. $MQTT.sub is required for QoS 1 by servers
    # before 2.12.4; no client can subscribe to it directly. "bms" is there because the MQTT topic filter bms/# includes it.
    Role.EDGE: (("raw.{{name()}}",), ("edge.{{name()}}.awaits", "$MQTT.sub.>")),
    Role.DASHBOARD: ((), ("bms", "bms.>", "fleet", "fleet.>", "$MQTT.sub.>")),
    Role.READER: (_READER_PUBLISH, (*_SUBSCRIBE, "hours.*")),
    Role.WORKER: (_WORKER_PUBLISH, _SUBSCRIBE),
    Role.SENDER: (("telemetry.*",), ("_INBOX.>", "ingest.*")),
    Role.MQTT_SENDER: (("telemetry.*",), ("ingest.*", "$MQTT.sub.>")),
    Role.INGEST: (_INGEST_PUBLISH, ("_INBOX.>", "edge.*.awaits", "fleet.ingest")),
    Role.ADMIN: ((">",), (">",)),
}
_LIMITS: dict[Role, dict[str, int]] = {
    # An edge has one subscription, for which the server creates three; the rest is a margin. nats-server 2.15 does not
    # apply ``payload`` to MQTT messages; the equal limit of the stream RAW applies to them.
    Role.EDGE: {"subs": 8, "payload": MAX_BLOCK_BYTES}
}
_DENIED: dict[Role, tuple[str, ...]] = {
    # A reader may create consumers, but must not use the consumers of the partitions.
    Role.READER: ("$JS.API.CONSUMER.DELETE.RAW.>", "$JS.API.CONSUMER.MSG.NEXT.RAW.>", "$JS.API.CONSUMER.UNPIN.>"),
    Role.WORKER: ("$JS.API.CONSUMER.DELETE.RAW.>",),
}


@dataclass(frozen=True)
class Key:
    """Key pair.

    Attributes:
        seed: Private key; not part of ``repr``.
    """

    seed: bytes

    @property
    def public(self) -> str:
        """Public key, which identifies the owner."""
        return str(nkeys.from_seed(self.seed).public_key.decode())

    def sign(self, data: bytes) -> bytes:
        """Return an ed25519 signature."""
        return bytes(nkeys.from_seed(self.seed).sign(data))

    def __repr__(self) -> str:
        return f"Key({self.public})"


def new_key(prefix: int) -> Key:
    """Create a key with the prefix ``ACCOUNT``, ``OPERATOR`` or ``USER``."""
    return Key(nkeys.encode_seed(os.urandom(32), prefix))


def parse_key(seed: bytes) -> Key:
    """Decode the text of a key file.

    Raises:
        ValueError: The seed is not a key.
    """
    try:
        nkeys.from_seed(seed)
    except Exception:  # noqa: BLE001 - nkeys raises various exceptions, whose texts may contain the seed
        raise ValueError("not a key") from None
    return Key(seed)


def user_key(signer: Key, role: Role, name: str) -> Key:
    """Return the key of a user, derived from the name so that its tokens can be revoked by name."""
    text = f"{role.value} {name}".encode()
    return Key(nkeys.encode_seed(hashlib.sha256(signer.seed + b"\0" + text).digest(), USER))


def operator_claims(key: Key, system: str) -> str:
    """Return the claims of the operator, which signs accounts.

    Args:
        key: Key of the operator.
        system: Public key of the account in which servers communicate.
    """
    return _signed(key, key.public, "fleet", {"system_account": system, "type": "operator"})


@dataclass(frozen=True)
class Tenant:
    """Account of a tenant.

    Attributes:
        name: Name shown by the server.
        public: Public key of the account.
        signers: Public key that signs the users of each role.
        disk_bytes: Maximum size of the tenant's streams with all replicas [bytes]; None: unlimited.
        revoked: Times by public key of a user [s since 1970]. Tokens of the user that were issued before this time are rejected.
    """

    name: str
    public: str
    signers: Mapping[Role, str]
    disk_bytes: int | None = None
    revoked: Mapping[str, int] | None = None


def account_claims(operator_key: Key, tenant: Tenant) -> str:
    """Return the claims of a tenant's account. They depend only on the tenant, so that all nodes have equal claims."""
    disk = _UNLIMITED if tenant.disk_bytes is None else tenant.disk_bytes
    claims = {
        "limits": {
            **_unlimited(),
            "conn": _UNLIMITED,
            "mem_storage": _UNLIMITED,
            "disk_storage": disk,
            "streams": _UNLIMITED,
            "consumer": _UNLIMITED,
        },
        "signing_keys": [_scope(role, key) for role, key in sorted(tenant.signers.items(), key=lambda item: item[1])],
        "revocations": dict(tenant.revoked or {}),
        "type": "account",
    }
    return _signed(operator_key, tenant.public, tenant.name, claims)


def system_account_claims(operator_key: Key, public: str) -> str:
    """Return the claims of the account in which servers communicate; it has no users."""
    limits = _unlimited() | {"conn": _UNLIMITED}
    return _signed(operator_key, public, "system", {"limits": limits, "type": "account"})


def user_token(
    signer: Key, account_key: str, role: Role, name: str, issued: datetime, expires: datetime | None = None
) -> str:
    """Return the token of a user.

    Args:
        signer: Signing key of the role.
        account_key: The account's public key.
        role: Role of the user.
        name: Name of the user; for an edge the name of its pack.
        issued: Issue time, which ``Tenant.revoked`` is compared with.
        expires: Expiry time; None: never.
    """
    claims = {"issuer_account": account_key, "type": "user"}
    expiry = {"exp": int(expires.timestamp())} if expires else {}
    times = {"iat": int(issued.timestamp())} | expiry
    return _signed(signer, user_key(signer, role, name).public, name, claims, times)


def credentials(token: str, key: Key) -> bytes:
    """Return the content of a credentials file: the token of a program, and the key with which it signs the challenge."""
    return (
        f"-----BEGIN NATS USER JWT-----\n{token}\n------END NATS USER JWT------\n\n"
        f"-----BEGIN USER NKEY SEED-----\n{key.seed.decode()}\n------END USER NKEY SEED------\n"
    ).encode()


def _scope(role: Role, public: str) -> dict[str, Any]:
    """Return the permissions of the users that a role's key signs."""
    publish, subscribe = _ALLOWED[role]
    template = {
        "pub": _permission(publish, _DENIED.get(role, ())),
        "sub": _permission(subscribe, ()),
        **_unlimited(),
        **_LIMITS.get(role, {}),
        "allowed_connection_types": ["MQTT"] if role in BEARER_ROLES else ["STANDARD"],
    }
    bearer = {"bearer_token": True} if role in BEARER_ROLES else {}
    return {"kind": "user_scope", "key": public, "role": role.value, "template": template | bearer}


def _permission(allow: tuple[str, ...], deny: tuple[str, ...]) -> dict[str, list[str]]:
    """Return a permission. An empty list would allow everything, therefore an empty ``allow`` denies all."""
    return {"allow": list(allow), "deny": list(deny)} if allow else {"deny": [">"]}


def _unlimited() -> dict[str, int]:
    return {"subs": _UNLIMITED, "data": _UNLIMITED, "payload": _UNLIMITED}


def _signed(signer: Key, subject: str, name: str, claims: dict[str, Any], times: dict[str, int] | None = None) -> str:
    """Return a signed JSON Web Token."""
    body = {"iss": signer.public, "sub": subject, "name": name, **(times or {})}
    token_id = hashlib.sha256(_json(body | {"nats": claims})).digest()
    body |= {"jti": base64.b32encode(token_id).rstrip(b"=").decode(), "nats": claims | {"version": _VERSION}}
    signed_part = f"{_base64(_json({'typ': 'JWT', 'alg': 'ed25519-nkey'}))}.{_base64(_json(body))}"
    return f"{signed_part}.{_base64(signer.sign(signed_part.encode()))}"


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), sort_keys=True).encode()


def _base64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()
