"""Claims that a server checks by signature alone: an operator, its tenants' accounts, their users.

A claim is a JSON Web Token with the parts of https://github.com/nats-io/jwt, version 2, signed with an ed25519 key in
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

ACCOUNT, OPERATOR, USER = nkeys.PREFIX_BYTE_ACCOUNT, nkeys.PREFIX_BYTE_OPERATOR, nkeys.PREFIX_BYTE_USER
"""Kinds of key."""
_VERSION = 2
_NONE = -1
"""Value of an absent limit."""


class Role(Enum):
    """Role of a tenant's user."""

    EDGE = "edge"
    """Role of an edge: sends the blocks of one pack, and receives the confirmations."""
    DASHBOARD = "dashboard"
    """Reads estimates over MQTT."""
    READER = "reader"
    """Reads all that there is: the page, questions, captures."""
    WORKER = "worker"
    """Estimates."""
    ADMIN = "admin"
    """Makes streams, sets packs."""


BEARERS = (Role.EDGE, Role.DASHBOARD)
"""Roles that connect by MQTT, which has no signatures: the holder of the token is the user."""

_READS = (
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
_ESTIMATES = (
    *_READS,
    "$JS.API.STREAM.PURGE.OBJ_states",
    "$KV.checkpoints.>",
    "$O.states.>",
    "edge.*.awaits",
    "bms.>",
    "hours.*",
    "fleet.>",
    "_INBOX.>",
)
_HEARS = ("_INBOX.>", "bms.>", "fleet.>")
_ALLOWED: dict[Role, tuple[tuple[str, ...], tuple[str, ...]]] = {
    # Publish, subscribe; {{name()}} is the user's name. Before 2.12.4 the server requires $MQTT.sub at QoS 1, to which no client can
    # subscribe by that name. bms/# includes bms.
    Role.EDGE: (("raw.{{name()}}",), ("edge.{{name()}}.awaits", "$MQTT.sub.>")),
    Role.DASHBOARD: ((), ("bms", "bms.>", "fleet", "fleet.>", "$MQTT.sub.>")),
    Role.READER: (_READS, _HEARS),
    Role.WORKER: (_ESTIMATES, _HEARS),
    Role.ADMIN: ((">",), (">",)),
}
_LIMITS: dict[Role, dict[str, int]] = {
    # An edge has one subscription, for which the server makes three. nats-server 2.15 does not compare an MQTT message with
    # ``payload``; the stream RAW has the same limit and does.
    Role.EDGE: {"subs": 8, "payload": MAX_BLOCK_BYTES}
}
_DENIED: dict[Role, tuple[str, ...]] = {
    # a reader creates consumers of its own, and must not touch those of the partitions
    Role.READER: ("$JS.API.CONSUMER.DELETE.RAW.>", "$JS.API.CONSUMER.MSG.NEXT.RAW.>", "$JS.API.CONSUMER.UNPIN.>"),
    Role.WORKER: ("$JS.API.CONSUMER.DELETE.RAW.>",),
}


@dataclass(frozen=True)
class Key:
    """A key pair.

    Attributes:
        seed: Private half, which is never shown.
    """

    seed: bytes

    @property
    def public(self) -> str:
        """The public half, by which the owner is known."""
        return str(nkeys.from_seed(self.seed).public_key.decode())

    def sign(self, data: bytes) -> bytes:
        """Return an ed25519 signature."""
        return bytes(nkeys.from_seed(self.seed).sign(data))

    def __repr__(self) -> str:
        return f"Key({self.public})"


def new_key(kind: int) -> Key:
    """Make a key of kind ``ACCOUNT``, ``OPERATOR`` or ``USER``."""
    return Key(nkeys.encode_seed(os.urandom(32), kind))


def key_of(seed: bytes) -> Key:
    """Return the key of a seed in its text form.

    Raises:
        ValueError: It is not a key.
    """
    try:
        nkeys.from_seed(seed)
    except Exception:  # noqa: BLE001 - the library raises what comes, and what it says may hold the seed
        raise ValueError("no key") from None
    return Key(seed)


def user_key(signer: Key, role: Role, name: str) -> Key:
    """Return the key of a user, derived from the name so that its tokens can be revoked by name."""
    text = f"{role.value} {name}".encode()
    return Key(nkeys.encode_seed(hashlib.sha256(signer.seed + b"\0" + text).digest(), USER))


def operator(key: Key, system: str) -> str:
    """Claims of the operator, which signs accounts.

    Args:
        key: Key of the operator.
        system: Public key of the account in which servers talk to each other.
    """
    return _signed(key, key.public, "fleet", {"system_account": system, "type": "operator"})


@dataclass(frozen=True)
class Tenant:
    """An account.

    Attributes:
        name: For people.
        public: The account's public key.
        signers: Public keys that sign the users of a role.
        disk_bytes: The most that its streams take, copies on other nodes counted; None: what there is.
        revoked: Public key of a user -> its tokens that were made before [s since 1970] are refused.
    """

    name: str
    public: str
    signers: Mapping[Role, str]
    disk_bytes: int | None = None
    revoked: Mapping[str, int] | None = None


def account(operator_key: Key, tenant: Tenant) -> str:
    """Claims of a tenant's account: the same for the same tenant, so that all nodes have the same."""
    disk = _NONE if tenant.disk_bytes is None else tenant.disk_bytes
    claims = {
        "limits": {
            **_unlimited(),
            "conn": _NONE,
            "mem_storage": _NONE,
            "disk_storage": disk,
            "streams": _NONE,
            "consumer": _NONE,
        },
        "signing_keys": [_scope(role, key) for role, key in sorted(tenant.signers.items(), key=lambda item: item[1])],
        "revocations": dict(tenant.revoked or {}),
        "type": "account",
    }
    return _signed(operator_key, tenant.public, tenant.name, claims)


def system_account(operator_key: Key, public: str) -> str:
    """Return the claims of the account in which servers communicate; it has no users."""
    limits = _unlimited() | {"conn": _NONE}
    return _signed(operator_key, public, "system", {"limits": limits, "type": "account"})


def user(signer: Key, account_key: str, role: Role, name: str, made: datetime, expires: datetime | None = None) -> str:
    """Make the token of a user.

    Args:
        signer: Signing key of the role.
        account_key: The account's public key.
        role: What the user is; the bearer of an edge's token is the edge.
        name: Name of the user; of an edge, its pack's.
        made: Revocation looks at it.
        expires: Expiry time; None: never.
    """
    claims = {"issuer_account": account_key, "type": "user"}
    expiry = {"exp": int(expires.timestamp())} if expires else {}
    times = {"iat": int(made.timestamp())} | expiry
    return _signed(signer, user_key(signer, role, name).public, name, claims, times)


def credentials(token: str, key: Key) -> bytes:
    """Return a credentials file: the token of a program and the key that proves its possession."""
    return (
        f"-----BEGIN NATS USER JWT-----\n{token}\n------END NATS USER JWT------\n\n"
        f"-----BEGIN USER NKEY SEED-----\n{key.seed.decode()}\n------END USER NKEY SEED------\n"
    ).encode()


def _scope(role: Role, public: str) -> dict[str, Any]:
    """Return the permissions of users that a key signs."""
    publish, subscribe = _ALLOWED[role]
    template = {
        "pub": _permission(publish, _DENIED.get(role, ())),
        "sub": _permission(subscribe, ()),
        **_unlimited(),
        **_LIMITS.get(role, {}),
        "allowed_connection_types": ["MQTT"] if role in BEARERS else ["STANDARD"],
    }
    bearer = {"bearer_token": True} if role in BEARERS else {}
    return {"kind": "user_scope", "key": public, "role": role.value, "template": template | bearer}


def _permission(allow: tuple[str, ...], deny: tuple[str, ...]) -> dict[str, list[str]]:
    """Return the permission; allowing nothing must deny all, because an empty list would allow all."""
    return {"allow": list(allow), "deny": list(deny)} if allow else {"deny": [">"]}


def _unlimited() -> dict[str, int]:
    return {"subs": _NONE, "data": _NONE, "payload": _NONE}


def _signed(signer: Key, subject: str, name: str, claims: dict[str, Any], times: dict[str, int] | None = None) -> str:
    body = {"iss": signer.public, "sub": subject, "name": name, **(times or {})}
    number = hashlib.sha256(_json(body | {"nats": claims})).digest()
    body |= {"jti": base64.b32encode(number).rstrip(b"=").decode(), "nats": claims | {"version": _VERSION}}
    text = f"{_base64(_json({'typ': 'JWT', 'alg': 'ed25519-nkey'}))}.{_base64(_json(body))}"
    return f"{text}.{_base64(signer.sign(text.encode()))}"


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), sort_keys=True).encode()


def _base64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()
