"""Record of all published fields and types. ``python -m tests.sinks.mqtt.payload_record`` rewrites its file."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bms_estimator.sinks.mqtt.topics import schema

RECORD = Path(__file__).with_name("payloads.json")


def now() -> dict[str, Any]:
    """Return version and fields of the present payloads."""
    schemas = schema()
    version = schemas.pop("payload_version")
    return {"payload_version": version, "fields": dict(sorted(fields(schemas)))}


def recorded() -> dict[str, Any]:
    return json.loads(RECORD.read_text(encoding="utf-8"))


def fields(schemas: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and types of each field, such as ``("parameters.a.*.value", "null, number")``."""
    for topic, described in schemas.items():
        yield from _walk(topic, described, described.get("$defs", {}))


def broken(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return the removed and changed fields."""
    return [
        f"{name}: was {kind}, is {after.get(name, 'gone')}" for name, kind in before.items() if after.get(name) != kind
    ]


def _walk(path: str, node: dict[str, Any], models: dict[str, Any]) -> Iterator[tuple[str, str]]:
    parts = [_resolved(part, models) for part in node.get("anyOf", [node])]
    yield path, ", ".join(sorted({part.get("type", "any") for part in parts}))
    for part in parts:
        for name, inner in part.get("properties", {}).items():
            yield from _walk(f"{path}.{name}", inner, models)
        for key, mark in (("additionalProperties", "*"), ("items", "[]")):
            if isinstance(part.get(key), dict):
                yield from _walk(f"{path}.{mark}", part[key], models)


def _resolved(node: dict[str, Any], models: dict[str, Any]) -> dict[str, Any]:
    return models[node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node


def main() -> int:
    after = now()
    before = recorded() if RECORD.exists() else after
    lost = broken(before["fields"], after["fields"])
    if lost and before["payload_version"] >= after["payload_version"]:
        sys.stderr.write("\n".join([*lost, "raise PAYLOAD_VERSION in bms_estimator/model/payloads.py"]) + "\n")
        return 1
    RECORD.write_text(json.dumps(after, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
