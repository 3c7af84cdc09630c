"""Generator of a commented settings file from the settings' models."""

import textwrap
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args, get_origin

import tomlkit
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

UNITS = {"v": "V", "a": "A", "s": "s", "h": "h", "hz": "Hz", "ah": "Ah", "ohm": "ohm", "c": "°C"}
"""Units by the part of a key after its last underscore."""
COMMENT_WIDTH = 110
"""Maximum line length of comments."""
HEADER_COMMENT = """\
# Settings of one pack. A setting that begins with # has the default value shown; remove the # to change it.
# A key such as poll_s ends in the unit of its value. Current is positive on discharge.
"""
_LIMIT_WORDS = {Gt: ("gt", "above"), Ge: ("ge", "at least"), Lt: ("lt", "below"), Le: ("le", "at most")}
"""Attribute with the value of a constraint, and its words in a comment, by the constraint's type."""

GivenSettings = Mapping[str, Mapping[str, object]]
"""Values by section and key, which replace the defaults."""


def settings_file(model: type[BaseModel], given: GivenSettings = MappingProxyType({})) -> str:
    """Return TOML text with the description, unit, constraints and default of each setting of ``model``.

    Args:
        model: Model of the whole file; each of its fields is a section.
        given: Settings that are written without ``#``. An optional section is written without ``#`` if it is given.
    """
    lines = [HEADER_COMMENT]
    for name, field in model.model_fields.items():
        is_optional = field.default is None
        effect_of_omission = f" {_sentence(field.description)}" if is_optional and field.description else ""
        for section in _models(field.annotation):  # [source] has one model for each kind of source
            values = given[name] if name in given and _is_kind(section, given[name]) else {}
            lines += _comment_lines(
                f"{_sentence((section.__doc__ or name).strip().splitlines()[0])}{effect_of_omission}"
            )
            lines += [f"{'#' if is_optional and not values else ''}[{name}]", *_setting_lines(section, values), ""]
    return "\n".join(lines).rstrip() + "\n"


def _is_kind(section: type[BaseModel], given: Mapping[str, object]) -> bool:
    """Return True if ``given`` are settings of this model, which matters only for the kinds of ``[source]``."""
    return "kind" not in given or given["kind"] in get_args(section.model_fields["kind"].annotation)


def _setting_lines(section: type[BaseModel], given: Mapping[str, object]) -> Iterator[str]:
    for name, field in section.model_fields.items():
        key = field.alias or name
        yield from _comment_lines(
            "  ".join(part for part in (field.description, _unit_and_constraints(key, field)) if part)
        )
        if key in given:
            yield f"{key} = {_as_toml(given[key])}"
        elif field.examples:  # instead of an empty default
            yield from (f"#{line}" for line in field.examples[0].splitlines())
        else:
            yield f"#{key} = {_default_as_toml(field)}"


def _as_toml(value: object) -> str:
    """Return a value as TOML in one line."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_as_toml(each)}' for key, each in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_as_toml, value))}]"
    return tomlkit.item(value).as_string()


def _default_as_toml(field: FieldInfo) -> str:
    """Return the default as TOML; for a required field the first choice of a literal, otherwise an empty text."""
    if get_origin(field.annotation) is Literal and field.is_required():
        return f'"{get_args(field.annotation)[0]}"'
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    if isinstance(default, BaseModel):
        values, default = default.model_dump(exclude_none=True), tomlkit.inline_table()
        default.update(values)
    return "" if default is None else tomlkit.item(default).as_string()


def _unit_and_constraints(key: str, field: FieldInfo) -> str:
    """Return unit and constraints, such as ``[V, at least 0]``; empty without unit and constraints."""
    choices, limits = _constraints(field.annotation)
    limits += [_limit_text(item) for item in field.metadata if type(item) in _LIMIT_WORDS]
    unit = [UNITS[key.rsplit("_", 1)[-1]]] if "_" in key and key.rsplit("_", 1)[-1] in UNITS else []
    one_of = [f"one of {', '.join(choices)}"] if len(choices) > 1 else [f"always {choice}" for choice in choices]
    parts = ", ".join(unit + one_of + limits)
    return f"[{parts}]" if parts else ""


def _constraints(annotation: Any) -> tuple[list[str], list[str]]:
    """Return all choices and limits within an annotation."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return [str(choice) for choice in arguments], []
    choices: list[str] = []
    limits: list[str] = []
    if origin is Annotated:
        for constraint in arguments[1:]:  # pydantic's Field keeps its constraints in ``metadata``
            items = getattr(constraint, "metadata", [constraint])
            limits += [_limit_text(item) for item in items if type(item) in _LIMIT_WORDS]
    for inner in arguments[:1] if origin is Annotated else arguments:
        inner_choices, inner_limits = _constraints(inner)
        choices += inner_choices
        limits += inner_limits
    return choices, limits


def _limit_text(constraint: Any) -> str:
    attribute, words = _LIMIT_WORDS[type(constraint)]
    return f"{words} {getattr(constraint, attribute):.10g}"


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models of an annotation, which may be optional or a union."""
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for argument in get_args(annotation) for model in _models(argument)]


def _sentence(text: str | None) -> str:
    """Return the text as a sentence, with a capital and a full stop."""
    text = (text or "").rstrip(".")
    return f"{text[:1].upper()}{text[1:]}."


def _comment_lines(text: str) -> list[str]:
    return textwrap.wrap(text, COMMENT_WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
