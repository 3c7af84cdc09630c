"""Record of all published fields and types. ``python -m tests.sinks.mqtt.payload_record`` rewrites the file ``payloads.json``."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bms_estimator.sinks.mqtt.topics import schema

RECORD = Path(__file__).with_name("payloads.json")


def current_record() -> dict[str, Any]:
    """Return version and fields of the payloads that the service publishes now."""
    schemas = schema()
    version = schemas.pop("payload_version")
    return {"payload_version": version, "fields": dict(sorted(fields(schemas)))}


def read_record() -> dict[str, Any]:
    """Return version and fields at the last time that the file was written."""
    return json.loads(RECORD.read_text(encoding="utf-8"))


def fields(schemas: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and types of each field, such as ``("parameters.a.*.value", "null, number")``."""
    for topic, topic_schema in schemas.items():
        yield from _walk(topic, topic_schema, topic_schema.get("$defs", {}))


def find_broken(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return a description of each field that was removed or whose types changed."""
    return [
        f"{name}: was {types}, is {after.get(name, 'gone')}"
        for name, types in before.items()
        if after.get(name) != types
    ]


def _walk(path: str, node: dict[str, Any], models: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and types of a part of a JSON schema, and of all parts inside it."""
    parts = [models[part["$ref"].rsplit("/", 1)[-1]] if "$ref" in part else part for part in node.get("anyOf", [node])]
    yield path, ", ".join(sorted({part.get("type", "any") for part in parts}))
    for part in parts:
        for name, inner in part.get("properties", {}).items():
            yield from _walk(f"{path}.{name}", inner, models)
        for key, suffix in (("additionalProperties", "*"), ("items", "[]")):
            if isinstance(part.get(key), dict):
                yield from _walk(f"{path}.{suffix}", part[key], models)


def main() -> int:
    """Write the record, unless the fields have changed in a way that needs a new version. Return the exit code."""
    after = current_record()
    before = read_record() if RECORD.exists() else after
    violations = find_broken(before["fields"], after["fields"])
    if violations and before["payload_version"] >= after["payload_version"]:
        sys.stderr.write(
            "\n".join([*violations, "raise PAYLOAD_VERSION in bms_estimator/model/payloads/health.py"]) + "\n"
        )
        return 1
    RECORD.write_text(json.dumps(after, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
