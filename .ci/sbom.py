"""Build hook: the wheel names what it was tested with, CycloneDX in .dist-info/sboms/ (PEP 770), from requirements.lock."""

import json
import re
import tempfile
import uuid
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ENTRY = re.compile(
    r"(?m)^(?P<name>[\w.-]+)==(?P<version>[^\s;\\]+)(?: ; (?P<marker>[^\\\n]+?))?(?: \\)?\n(?P<rest>(?:    .*\n)+)"
)


class SbomHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the file to the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002 - hatchling's names
        """Before the wheel is packed."""
        lock = Path(self.root, "requirements.lock").read_text(encoding="utf-8")
        direct = {re.split(r"[^\w-]", line)[0] for line in self.metadata.core.dependencies}
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name, "bms_estimator.cdx.json")
        bom = sbom(self.metadata.name, self.metadata.version, direct, lock)
        path.write_text(json.dumps(bom, indent=1), encoding="utf-8")
        build_data["sbom_files"].append(str(path))

    def finalize(self, *_: object) -> None:
        """After it."""
        self._folder.cleanup()


def sbom(name: str, version: str, direct: set[str], lock: str) -> dict[str, Any]:
    """CycloneDX 1.6 of a package and all that it needs at run time.

    Args:
        name: Of the package.
        version: Of the package.
        direct: Names of what it needs itself.
        lock: Text of requirements.lock; its ``# via`` lines tell who needs what.
    """
    entries = {entry["name"]: entry for entry in ENTRY.finditer(lock)}
    users = {name: set(re.findall(r"#(?: via)? +([\w.-]+)", entry["rest"])) for name, entry in entries.items()}
    needed, before = direct & set(entries), set[str]()
    while needed != before:
        before, needed = needed, needed | {name for name, by in users.items() if by & needed}
    main = purl(name, version)
    refs = {one: purl(one, entries[one]["version"]) for one in sorted(needed)}
    uses = {main: sorted(refs[one] for one in direct & needed)}
    uses |= {ref: sorted(refs[other] for other in needed if one in users[other]) for one, ref in refs.items()}
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": uuid.uuid5(uuid.NAMESPACE_URL, main + lock).urn,
        "version": 1,
        "metadata": {
            "component": {"type": "application", "bom-ref": main, "name": name, "version": version, "purl": main}
        },
        "components": [component(entries[one], ref) for one, ref in refs.items()],
        "dependencies": [{"ref": ref, "dependsOn": others} for ref, others in uses.items()],
    }


def component(entry: "re.Match[str]", ref: str) -> dict[str, Any]:
    """One package, with the digests of all its files for all machines."""
    digests = re.findall(r"--hash=sha256:([0-9a-f]{64})", entry["rest"])
    found = {"type": "library", "bom-ref": ref, "name": entry["name"], "version": entry["version"], "purl": ref}
    found["hashes"] = [{"alg": "SHA-256", "content": digest} for digest in digests]
    if entry["marker"]:
        found["properties"] = [{"name": "bms_estimator:marker", "value": entry["marker"].strip()}]
    return found


def purl(name: str, version: str) -> str:
    """Package URL."""
    return f"pkg:pypi/{name.lower().replace('_', '-')}@{version}"
