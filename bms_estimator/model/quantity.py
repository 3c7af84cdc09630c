"""Properties of published numbers that every sink needs, as annotations of the payloads' fields.

A field annotated with ``Quantity`` appears in the payload, its schema, the reference, Prometheus and Home Assistant without
an entry elsewhere.
"""

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from pydantic import BaseModel

FAST_INTERVAL_S = 15.0
"""Minimum interval between two recorded values of a quantity that changes with the load, in Home Assistant [s]."""
SLOW_INTERVAL_S = 60.0
"""Minimum interval between two recorded values of any other quantity, in Home Assistant [s]."""


class Entity(NamedTuple):
    """Numeric entity of Home Assistant."""

    name: str | None
    """Name; None: Home Assistant's name of the device class, in the user's language."""
    unit: str | None
    decimals: int
    """Number of decimals of a published value."""
    step: float
    """Minimum change that is published, in the entity's unit. It exceeds the noise."""
    device_class: str | None = None
    min_interval_s: float = SLOW_INTERVAL_S
    """Minimum interval between two published changes [s]."""
    is_primary: bool = False
    """True for a primary entity; others are listed as diagnostics."""
    enabled: bool = True
    """True if enabled by default."""
    state_class: str | None = "measurement"
    signed: bool = False
    """True if the sign depends on the configured direction of positive current."""
    icon: str | None = None
    """Name of the icon in Material Design Icons; None: that of the device class."""
    factor: float = 1.0
    """Factor from the field of the payload to the entity's unit."""
    immediate_step: float = math.inf
    """Minimum change that is published at once, for example after a user has set the SOC."""


def raw_entity(name: str, unit: str | None, decimals: int, device_class: str | None = None) -> Entity:
    """Return the entity of an internal value of the observer, disabled by default."""
    return Entity(name, unit, decimals, 10.0**-decimals, device_class, enabled=False)


def total_entity(name: str, unit: str | None, decimals: int, device_class: str | None = None) -> Entity:
    """Return the entity of a total over all runs."""
    step = 10.0**-decimals
    return Entity(name, unit, decimals, step, device_class, is_primary=True, state_class="total_increasing")


def counter_entity(name: str) -> Entity:
    """Return the entity of a counter since start, disabled by default."""
    return Entity(name, None, 0, 1.0, enabled=False, state_class="total_increasing")


@dataclass(frozen=True)
class Quantity:
    """Properties of a published number.

    Attributes:
        entity: Entity in Home Assistant; None: it has none.
        packs: Packs that have the entity: all, batteries, or packs with cell voltages.
        prometheus: Kind of the Prometheus metric. A ``ratio`` is a gauge from 0 to 1.
    """

    entity: Entity | None = None
    packs: Literal["all", "batteries", "with cell voltages"] = field(default="all", kw_only=True)
    prometheus: Literal["gauge", "counter", "ratio", "none"] = field(default="gauge", kw_only=True)


def quantity(model: type[BaseModel], name: str) -> Quantity:
    """Return the annotation of a field, or the defaults of a field without one."""
    annotations = (each for each in model.model_fields[name].metadata if isinstance(each, Quantity))
    return next(annotations, Quantity())


def field_entities(model: type[BaseModel], packs: str) -> dict[str, Entity]:
    """Return the entities of a payload by field, for one value of ``Quantity.packs``."""
    quantities = {name: quantity(model, name) for name in model.model_fields}
    return {name: each.entity for name, each in quantities.items() if each.entity and each.packs == packs}
