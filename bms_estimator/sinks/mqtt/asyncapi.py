"""All topics as an AsyncAPI 3 document, made from the models. Pure."""

from typing import Any

from pydantic.json_schema import models_json_schema

from bms_estimator.model.payloads import PAYLOAD_VERSION
from bms_estimator.settings.pack import DEVICE_NAME, MAX_RATE_HZ, MIN_RATE_HZ
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.sinks.mqtt.requests import COMMANDS, MAX_PAYLOAD_BYTES
from bms_estimator.sinks.mqtt.topics import TOPICS
from bms_estimator.version import __version__

Document = dict[str, Any]

ADDRESSES = {"alarm": "alarm/{alarm}"}
"""Addresses below the device's topic that differ from the name."""
PARAMETERS = {
    "device": f"pack.name of the pack file, as {DEVICE_NAME}",
    "alarm": "as in [alarms] of the pack file",
}
AVAILABILITIES = {
    AVAILABILITY: "whether the service lives; its last will",
    SENSOR_AVAILABILITY: "whether values are fresh",
}
TRANSACTION = {"type": ["string", "integer", "null"], "description": "repeated in the response"}
ARGUMENTS: dict[str, Document] = {
    "set_soc": {"soc": {"type": "number", "minimum": 0, "maximum": 1, "description": "state of charge"}},
    "current_zero": {},
    "acknowledge_alarm": {"name": {"type": ["string", "null"], "description": "of an alarm; all when left out"}},
    "publish_rate": {"rate_hz": {"type": "number", "minimum": MIN_RATE_HZ, "maximum": MAX_RATE_HZ}},
}
"""Fields of each command."""
OPTIONAL = ("name",)
"""Fields that may be left out."""
RESPONSE = {
    "type": "object",
    "properties": {
        "status": {"enum": ["ok", "error"]},
        "data": {"type": ["object", "null"]},
        "error": {"type": ["string", "null"], "description": "why not, for people"},
        "transaction": TRANSACTION,
    },
    "required": ["status", "data", "error", "transaction"],
}


def document(base_topic: str) -> Document:
    """Return the AsyncAPI document.

    Args:
        base_topic: First part of all topics.
    """
    channels: Document = {}
    operations: Document = {}
    messages: Document = {}

    def channel(name: str, address: str, *of: str) -> None:
        used = [parameter for parameter in PARAMETERS if f"{{{parameter}}}" in f"{base_topic}/{{device}}/{address}"]
        channels[name] = {
            "address": f"{base_topic}/{{device}}/{address}",
            "messages": {message: _ref("messages", message) for message in of},
            "parameters": {parameter: {"description": PARAMETERS[parameter]} for parameter in used},
        }

    def sent(name: str, when: str, qos: int, *, retain: bool) -> None:
        binding = {"mqtt": {"qos": qos, "retain": retain, "bindingVersion": "0.2.0"}}
        operations[f"send_{name}"] = {"action": "send", "channel": _channel(name), "summary": when, "bindings": binding}

    for name, topic in TOPICS.items():
        channel(name, ADDRESSES.get(name, name), name)
        sent(name, topic.when, topic.qos, retain=topic.retain)
        messages[name] = {"contentType": "application/json", "payload": _ref("schemas", topic.model.__name__)}
    for address, meaning in AVAILABILITIES.items():
        name = address.replace("/", "_")
        channel(name, address, name)
        sent(name, meaning, 1, retain=True)
        messages[name] = {"contentType": "text/plain", "payload": {"type": "string", "enum": ["online", "offline"]}}
    messages["response"] = {"contentType": "application/json", "payload": RESPONSE}
    for name in COMMANDS:
        request, response = f"request_{name}", f"response_{name}"
        channel(request, f"request/{name}", request)
        channel(response, f"response/{name}", "response")
        messages[request] = {"contentType": "application/json", "payload": _arguments(name)}
        operations[f"answer_{name}"] = {
            "action": "receive",
            "channel": _channel(request),
            "reply": {"channel": _channel(response)},
        }
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "bms_estimator",
            "version": f"{PAYLOAD_VERSION}.0.0",
            "description": f"What bms_estimator {__version__} publishes of each pack, and may be asked. "
            "Current and power are positive on discharge; what is not known is null.",
            "license": {"name": "MIT"},
        },
        "defaultContentType": "application/json",
        "servers": {"broker": {"host": "localhost:1883", "protocol": "mqtt", "description": "mqtt.url of pack.toml"}},
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": _schemas()},
    }


def _schemas() -> Document:
    """JSON schemas of all models and their parts."""
    models = [(topic.model, "serialization") for topic in TOPICS.values()]
    _, made = models_json_schema(models, ref_template="#/components/schemas/{model}")  # type: ignore[arg-type]  # a literal
    schemas: Document = made["$defs"]
    return schemas


def _arguments(name: str) -> Document:
    """Return the arguments of a request."""
    own = ARGUMENTS[name]
    return {
        "type": "object",
        "properties": own | {"transaction": TRANSACTION},
        "required": [field for field in own if field not in OPTIONAL],
        "description": f"at most {MAX_PAYLOAD_BYTES} bytes; may be empty where nothing is required",
    }


def _ref(kind: str, name: str) -> Document:
    return {"$ref": f"#/components/{kind}/{name}"}


def _channel(name: str) -> Document:
    return {"$ref": f"#/channels/{name}"}
