"""``bms-estimator asyncapi``: topics and payloads for programs, as an AsyncAPI 3 document from the payload models."""

import json
from typing import Annotated, Any

import typer
from pydantic.json_schema import models_json_schema

from bms_estimator.model.payloads.health import PAYLOAD_VERSION
from bms_estimator.mqtt.connection import MAX_BYTES
from bms_estimator.settings.connections import MqttSettings
from bms_estimator.settings.pack import DEVICE_NAME, MAX_RATE_HZ, MIN_RATE_HZ
from bms_estimator.sinks.mqtt.messages import AVAILABILITY, SENSOR_AVAILABILITY
from bms_estimator.sinks.mqtt.requests import COMMANDS, MAX_PAYLOAD_BYTES, READS
from bms_estimator.sinks.mqtt.topics import TOPICS
from bms_estimator.version import __version__

Document = dict[str, Any]

ADDRESSES = {"alarm": "alarm/{alarm}"}
"""Topics below the device's topic, by channel name, if they differ from this name."""
PARAMETERS = {
    "device": f"pack.name of the pack file, as {DEVICE_NAME}",
    "alarm": "as in [alarms] of the pack file",
}
AVAILABILITIES = {
    AVAILABILITY: "online while the service runs; also its last will",
    SENSOR_AVAILABILITY: "online while values are fresh",
}
TRANSACTION = {"type": ["string", "integer", "null"], "description": "repeated in the response"}
"""JSON schema of the field ``transaction`` of requests and responses."""
PROFILE = {
    "type": "array",
    "minItems": 2,
    "items": {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
}
"""JSON schema of a list of pairs of time [s] and load."""
ARGUMENTS: dict[str, Document] = {
    "set_soc": {"soc": {"type": "number", "minimum": 0, "maximum": 1, "description": "state of charge"}},
    "current_zero": {},
    "acknowledge_alarm": {"name": {"type": ["string", "null"], "description": "name of an alarm; default: all"}},
    "publish_rate": {"rate_hz": {"type": "number", "minimum": MIN_RATE_HZ, "maximum": MAX_RATE_HZ}},
    "forget_pack": {},
    "forecast": {
        "power_w": {"type": "number", "description": "constant power [W], positive on discharge"},
        "current_a": {"type": "number", "description": "constant current [A], positive on discharge"},
        "duration_s": {"type": "number", "description": "duration of the constant load [s]; default: no end"},
        "profile": PROFILE
        | {"description": "pairs of time [s] and power [W] until the next time; the last is the end"},
        "current_profile": PROFILE | {"description": "as profile, with current [A]"},
    },
}
"""JSON schemas of the fields of each request."""
OPTIONAL = ("name", *ARGUMENTS["forecast"])
"""Optional fields of requests."""
RESPONSE = {
    "type": "object",
    "properties": {
        "status": {"enum": ["ok", "error"]},
        "data": {"type": ["object", "null"]},
        "error": {"type": ["string", "null"], "description": "reason for an error, for people"},
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

    def add_channel(name: str, address: str, *message_names: str) -> None:
        used = [parameter for parameter in PARAMETERS if f"{{{parameter}}}" in f"{base_topic}/{{device}}/{address}"]
        channels[name] = {
            "address": f"{base_topic}/{{device}}/{address}",
            "messages": {message: _ref("messages", message) for message in message_names},
            "parameters": {parameter: {"description": PARAMETERS[parameter]} for parameter in used},
        }

    def add_send_operation(name: str, when: str, qos: int, *, retain: bool) -> None:
        binding = {"mqtt": {"qos": qos, "retain": retain, "bindingVersion": "0.2.0"}}
        operations[f"send_{name}"] = {"action": "send", "channel": _channel(name), "summary": when, "bindings": binding}

    for name, topic in TOPICS.items():
        add_channel(name, ADDRESSES.get(name, name), name)
        add_send_operation(name, topic.when, topic.qos, retain=topic.retain)
        messages[name] = {"contentType": "application/json", "payload": _ref("schemas", topic.model.__name__)}
    for address, meaning in AVAILABILITIES.items():
        name = address.replace("/", "_")
        add_channel(name, address, name)
        add_send_operation(name, meaning, 1, retain=True)
        messages[name] = {"contentType": "text/plain", "payload": {"type": "string", "enum": ["online", "offline"]}}
    messages["response"] = {"contentType": "application/json", "payload": RESPONSE}
    for name in COMMANDS + READS:
        request, response = f"request_{name}", f"response_{name}"
        add_channel(request, f"request/{name}", request)
        add_channel(response, f"response/{name}", "response")
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
            "description": f"Topics that bms_estimator {__version__} publishes for each pack, and its requests. "
            "Current and power are positive on discharge. Unknown values are null.",
            "license": {"name": "MIT"},
        },
        "defaultContentType": "application/json",
        "servers": {"broker": {"host": "localhost:1883", "protocol": "mqtt", "description": "mqtt.url of pack.toml"}},
        "channels": channels,
        "operations": operations,
        "components": {"messages": messages, "schemas": _schemas()},
    }


def _schemas() -> Document:
    """Return the JSON schemas of all payload models and of the models that they contain."""
    models = [(topic.model, "serialization") for topic in TOPICS.values()]
    _, definitions = models_json_schema(models, ref_template="#/components/schemas/{model}")  # type: ignore[arg-type]  # a literal
    schemas: Document = definitions["$defs"]
    return schemas


def _arguments(name: str) -> Document:
    """Return the JSON schema of a request's arguments."""
    arguments = ARGUMENTS[name]
    return {
        "type": "object",
        "properties": arguments | {"transaction": TRANSACTION},
        "required": [field for field in arguments if field not in OPTIONAL],
        "description": f"at most {_max_size(name)}; may be empty if no field is required",
    }


def _max_size(name: str) -> str:
    """Return the maximum size of a request, as text. The longer requests of ``READS`` are limited by the connection."""
    return f"{MAX_BYTES} bytes with its topic" if name in READS else f"{MAX_PAYLOAD_BYTES} bytes"


def _ref(kind: str, name: str) -> Document:
    return {"$ref": f"#/components/{kind}/{name}"}


def _channel(name: str) -> Document:
    return {"$ref": f"#/channels/{name}"}


def asyncapi(
    base_topic: Annotated[str, typer.Option(help="prefix of the topics, as mqtt.base_topic in the settings")] = str(
        MqttSettings.model_fields["base_topic"].default
    ),
) -> None:
    """Print all MQTT topics and payloads as an AsyncAPI 3 document."""
    typer.echo(json.dumps(document(base_topic), indent=2, allow_nan=False))
