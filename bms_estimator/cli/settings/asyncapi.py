"""``bms-estimator asyncapi``: topics and payloads for programs."""

import json
from typing import Annotated

import typer

from bms_estimator.settings.mqtt import MqttSettings
from bms_estimator.sinks.mqtt.asyncapi import document


def asyncapi(
    base_topic: Annotated[str, typer.Option(help="prefix of the topics, as mqtt.base_topic in the settings")] = str(
        MqttSettings.model_fields["base_topic"].default
    ),
) -> None:
    """Print all MQTT topics and payloads as an AsyncAPI 3 document."""
    typer.echo(json.dumps(document(base_topic), indent=2, allow_nan=False))
