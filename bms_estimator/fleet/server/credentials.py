"""Folder of a fleet's keys and credentials. Missing files are created, readable by their owner only.

::

    operator.nk              private key that signs accounts; its holder controls all tenants
    claims.json              claims for the servers; public, equal on all nodes
    TENANT/account.nk        key of the account
    TENANT/<role>.nk         key that signs users of a role (``jwt_claims.Role``)
    TENANT/admin.creds       credentials of programs; likewise worker.creds, reader.creds, ingest.creds and sender.creds
    TENANT/dashboard.token   MQTT password of readers of estimates; likewise mqtt-sender.token of senders of telemetry

Private keys need not be copied: other nodes need only ``claims.json``.
"""

import json
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path

from bms_estimator.fleet.server import jwt_claims
from bms_estimator.fleet.server.disk_space import GB
from bms_estimator.fleet.server.jwt_claims import ACCOUNT, BEARER_ROLES, OPERATOR, Key, Role, Tenant
from bms_estimator.fleet.server.nats_config import Accounts
from bms_estimator.model.errors import TemporaryError, UserError
from bms_estimator.process.state_folder import UnsafeFileError, read_private, write_private
from bms_estimator.settings.fleet import TenantSettings

CLAIMS = "claims.json"
"""Name of the file with the claims."""
_MAX_KEY_BYTES = 200
"""Maximum size of a key file [bytes]."""
_MAX_CLAIMS_BYTES = 64 << 20
"""Maximum size of ``claims.json`` [bytes]."""


def has_keys(folder: Path) -> bool:
    """Return True if this machine has the private keys."""
    return (folder / "operator.nk").exists()


def make_accounts(folder: Path, tenants: Mapping[str, TenantSettings], now: datetime) -> Accounts:
    """Return the claims of the operator and all tenants; create missing keys and credentials.

    Args:
        folder: Folder of the keys; created if missing.
        tenants: Settings by tenant name.
        now: Issue time of new credentials.

    Raises:
        UserError: The folder cannot be read or written, or contains an invalid key.
    """
    operator, system = (
        _read_or_create_key(folder / "operator.nk", OPERATOR),
        _read_or_create_key(folder / "system.nk", ACCOUNT),
    )
    accounts = {system.public: jwt_claims.system_account_claims(operator, system.public)}
    for name, settings in sorted(tenants.items()):
        tenant = _tenant(folder / name, name, settings)
        accounts[tenant.public] = jwt_claims.account_claims(operator, tenant)
        _write_users(folder / name, tenant.public, now)
    claims = Accounts(jwt_claims.operator_claims(operator, system.public), system.public, accounts)
    write_file(folder / CLAIMS, json.dumps(vars(claims), indent=1).encode())
    return claims


def read_accounts(folder: Path) -> Accounts:
    """Read the claims that another machine has created.

    Raises:
        UserError: The file is missing or invalid.
    """
    path = folder / CLAIMS
    try:
        return Accounts(**json.loads(_read(path, _MAX_CLAIMS_BYTES)))
    except (ValueError, TypeError):
        raise UserError(f"{path}: not a claims file of a fleet: copy it from the node that has the keys") from None


def edge_tokens(
    folder: Path, tenant: str, packs: Iterable[str], now: datetime, expires: datetime | None = None
) -> dict[str, str]:
    """Return by pack the tokens that edges send as MQTT password.

    Args:
        folder: Folder of the keys.
        tenant: Tenant of the packs.
        packs: Packs whose blocks the tokens allow to send.
        now: Issue time.
        expires: Expiry time; None: never.

    Raises:
        UserError: The tenant has no keys.
    """
    signer, account = folder / tenant / f"{Role.EDGE.value}.nk", folder / tenant / "account.nk"
    if not signer.exists() or not account.exists():
        tenants = sorted(path.parent.name for path in folder.glob("*/account.nk"))
        hint = f"there are {', '.join(tenants)}" if tenants else "start `fleet serve` with it first"
        raise UserError(f"{folder}: no keys of a tenant {tenant}: {hint}")
    key, public = _read_key(signer), _read_key(account).public
    return {pack: jwt_claims.user_token(key, public, Role.EDGE, pack, now, expires) for pack in packs}


def write_tokens(path: Path, tokens: Mapping[str, str]) -> None:
    """Write tokens, readable by their owner only: to a CSV file if the name ends in .csv, otherwise to files PACK.token of a folder.

    Raises:
        TemporaryError: A file cannot be written.
    """
    if path.suffix == ".csv":
        rows = "".join(f"{pack},{token}\n" for pack, token in tokens.items())
        write_file(path, f"pack,token\n{rows}".encode())
        return
    for pack, token in tokens.items():
        write_file(path / f"{pack}.token", token.encode())


def credentials_file(folder: Path, tenant: str, role: Role) -> Path:
    """Return the path of a role's credentials file, or token file for a role that connects by MQTT."""
    return folder / tenant / f"{role.value}.{'token' if role in BEARER_ROLES else 'creds'}"


def _tenant(folder: Path, name: str, settings: TenantSettings) -> Tenant:
    signers = {role: _read_or_create_key(folder / f"{role.value}.nk", ACCOUNT) for role in Role}
    revoked = {
        jwt_claims.user_key(signers[Role.EDGE], Role.EDGE, pack).public: int(before.timestamp())
        for pack, before in settings.revoked.items()
    }
    return Tenant(
        name=name,
        public=_read_or_create_key(folder / "account.nk", ACCOUNT).public,
        signers={role: key.public for role, key in signers.items()},
        disk_bytes=None if settings.disk_gb is None else round(GB * settings.disk_gb),
        revoked=revoked,
    )


def _write_users(folder: Path, account: str, now: datetime) -> None:
    """Write the missing credentials and tokens of all roles except edges."""
    for role in Role:
        path = credentials_file(folder.parent, folder.name, role)
        if role is Role.EDGE or path.exists():
            continue
        signer = _read_key(folder / f"{role.value}.nk")
        token = jwt_claims.user_token(signer, account, role, role.value, now)
        key = jwt_claims.user_key(signer, role, role.value)
        write_file(path, token.encode() if role in BEARER_ROLES else jwt_claims.credentials(token, key))


def _read_or_create_key(path: Path, prefix: int) -> Key:
    """Read a key file. If it is missing, create it with a new key of ``prefix``."""
    if not path.exists():
        write_file(path, jwt_claims.new_key(prefix).seed)
    return _read_key(path)


def _read_key(path: Path) -> Key:
    try:
        return jwt_claims.parse_key(_read(path, _MAX_KEY_BYTES).strip())
    except ValueError:
        raise UserError(f"{path}: not a key; put the right file back") from None


def _read(path: Path, max_bytes: int) -> bytes:
    try:
        return read_private(path, max_bytes)
    except UnsafeFileError as error:
        raise UserError(f"{path}: {error}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None


def write_file(path: Path, content: bytes) -> None:
    """Write a file, readable by its owner only.

    Raises:
        TemporaryError: The file cannot be written.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_private(path, content)
    except OSError as error:
        raise TemporaryError(f"{path}: cannot be written: {error.strerror}") from error
