"""Reader of TOML files into pydantic models, with errors that name file, key, value and constraint."""

import re
import shutil
import tomllib
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
)
from pydantic_core.core_schema import CoreSchema, no_info_after_validator_function, no_info_before_validator_function

from bms_estimator.model.errors import UserError


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return ``; is X meant?`` for the most similar known name, regardless of case; empty if none is similar."""
    known_by_lower_case = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), known_by_lower_case, n=1)
    return f"; is {known_by_lower_case[close[0]]} meant?" if close else ""


@dataclass(frozen=True)
class OneOf:
    """Annotation of a ``str`` field that allows only ``names``, a ``Literal`` at run time. The JSON schema lists the names."""

    names: Collection[str]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return no_info_after_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return handler(schema) | {"enum": list(self.names)}

    def _check(self, name: str) -> str:
        if name not in self.names:
            raise ValueError(f"must be one of {', '.join(self.names)}{suggestion(name, self.names)}")
        return name


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


def _require_number(value: object) -> object:
    """Return a number unchanged.

    Raises:
        ValueError: The value is a boolean or a string. Pydantic would convert ``true`` to 1 and "3_9" to 39.
    """
    if isinstance(value, bool):
        raise ValueError("must be a number")  # noqa: TRY004 - pydantic handles ValueError as an invalid value
    if isinstance(value, str):
        raise ValueError("must be a number, without quotes")  # noqa: TRY004
    return value


def _make_strict(schema: Any) -> None:
    """Restrict numbers and booleans within a schema to their exact types."""
    schema_type = schema.get("type") if isinstance(schema, dict) else None
    if schema_type == "bool":
        schema["strict"] = True
    elif schema_type in ("int", "float"):
        lax_schema = dict(schema)
        schema.clear()
        schema.update(no_info_before_validator_function(_require_number, lax_schema))
    else:
        parts = schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ()
        for part in parts:
            _make_strict(part)


class Strict(BaseModel):
    """Base of all configured values. Unknown keys and values of other types are errors. Instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema with strict numbers and booleans."""
        schema = handler(source)
        _make_strict(schema)
        return schema


T = TypeVar("T", bound=BaseModel)
MAX_LISTED_KEYS = 20
"""Maximum number of keys of a section that an error on an unknown key lists."""


MESSAGES = {
    "model_type": "must be a table, {key = value}",
    "tuple_type": "must be a list, [value, ...]",
    "string_type": "must be a text in quotes",
    "string_too_short": "must not be empty",
    "path_type": "must be a path in quotes",
    "bool_type": "must be true or false",
    "string_pattern_mismatch": "is not of the form that it must have",
}
"""Replacements for messages of pydantic that only programmers understand, by error type."""


def error_reason(detail: Any) -> str:
    """Return the reason of a validation error in the words of this program.

    Args:
        detail: One of the errors of a ``ValidationError``.
    """
    text: str = detail["msg"].removeprefix("Value error, ").replace("Input should be", "must be", 1)
    return MESSAGES.get(detail["type"], text)


def read_toml(path: Path, model: type[T]) -> T:
    """Load and validate a TOML file.

    Raises:
        UserError: The file cannot be read, is not TOML, or contains invalid keys or values, with one line for each.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows write a byte order mark
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None
    return parse_toml(text, model, str(path))


def parse_toml(text: str, model: type[T], path: str) -> T:
    """Validate the text of a TOML file; ``path`` is its name in messages.

    Raises:
        UserError: The text is not TOML or contains invalid keys or values, with one line for each.
    """
    try:
        table = tomllib.loads(text)
    except ValueError as error:  # also an integer of more digits than Python converts
        raise UserError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise UserError(f"{path}: not valid TOML: nested too deeply") from None
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise UserError("\n".join(_error_line(path, model, table, detail) for detail in error.errors())) from None


def _error_line(path: str, model: type[BaseModel], table: object, detail: Any) -> str:
    """Return the message of one error: ``pack.toml: cell.capacity_ah = -6.6: must be above 0 (rated capacity ...)``.

    ``table`` is the content of the file, and ``detail`` an error of pydantic.
    """
    keys = _key_path(table, detail)
    full_key = ".".join(keys)
    described = _description(model, keys)
    hint = f" ({described})" if described else ""
    if detail["type"] in ("missing", "union_tag_not_found"):
        return f"{path}: {full_key}: missing{hint}"
    if detail["type"] == "extra_forbidden":
        return f"{path}: {full_key}: unknown key{_suggestion(model, keys)}"
    if detail["type"] == "union_tag_invalid":
        tag, expected = detail["ctx"]["tag"], detail["ctx"]["expected_tags"]
        similar = suggestion(tag, _quoted(expected))
        return f"{path}: {full_key}.{_discriminator(detail)} = {tag!r}: must be one of {expected}{similar}"
    message = error_reason(detail)
    if detail["type"] == "literal_error" and (expected := _quoted(detail["ctx"]["expected"])):
        message = f"must be one of {', '.join(expected)}{suggestion(str(detail['input']), expected)}"
    if detail["type"] == "string_pattern_mismatch" and not hint:
        message = detail["msg"]  # without a description of the form, the pattern is better than nothing
    if isinstance(detail["input"], dict):  # a whole section is too long for the message
        return ": ".join(filter(None, (path, full_key, message)))
    return f"{path}: {full_key} = {without_secrets(repr(detail['input']))}: {message}{hint}"


def _key_path(table: object, detail: Any) -> list[str]:
    """Return the path of keys in the file to an error, without the model names that pydantic inserts."""
    keys, location = [], detail["loc"]
    for key in location[:-1]:
        if isinstance(table, dict) and key in table:
            keys.append(str(key))
            table = table[key]
        elif isinstance(table, list) and isinstance(key, int):
            keys.append(str(key))
            table = table[key] if key < len(table) else None
    missing_key = [_discriminator(detail)] if detail["type"] == "union_tag_not_found" else []
    # the location of an error in a whole model may end with the name of the model, which is not a key
    is_model = detail["type"] == "value_error" and location and not _can_contain(table, location[-1])
    last_key = [] if is_model else location[-1:]
    return [*keys, *map(str, last_key), *missing_key]


def _quoted(text: str) -> list[str]:
    """Return the words in single quotes, the form in which pydantic lists allowed values."""
    return re.findall(r"'([^']*)'", text)


def _discriminator(detail: Any) -> str:
    """Return the key that selects one of several models."""
    return str(detail["ctx"]["discriminator"]).strip("'")


def _suggestion(model: type[BaseModel], keys: list[str]) -> str:
    """Return a suggestion for an unknown key: a similar key, or all keys if they are few; otherwise an empty text."""
    models = _models_at(model, keys[:-1])
    known = list(dict.fromkeys(field.alias or name for m in models for name, field in m.model_fields.items()))
    if similar := suggestion(keys[-1], known):
        return similar
    return f"; there are {', '.join(known)}" if len(models) == 1 and 0 < len(known) <= MAX_LISTED_KEYS else ""


def _models_at(model: type[BaseModel], keys: list[str]) -> list[type[BaseModel]]:
    """Return the models at the end of a path of keys."""
    current = [model]
    for key in keys:
        fields = [field for m in current for name, field in m.model_fields.items() if key in (name, field.alias)]
        current = [inner for field in fields for inner in _models(field.annotation)]
    return current


def _can_contain(table: object, key: object) -> bool:
    """Return True if ``table`` can contain ``key``."""
    return key in table if isinstance(table, dict) else isinstance(table, list)


def _description(model: type[BaseModel], keys: list[str]) -> str:
    """Return the description of the last key's field; empty if it has none."""
    described, current = "", [model]
    for key in keys:
        fields = [m.model_fields[key] for m in current if key in m.model_fields]
        described = fields[0].description or "" if fields else ""
        if fields:
            current = _models(fields[0].annotation)
    return described


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models within an annotation: the annotation itself, or the members of a union."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def without_secrets(text: str) -> str:
    """Return a text in which *** replaces the user name and password of a URL.

    Everything before the last @ is replaced. In a URL without @, a text in place of the port may be the password and is replaced.
    """
    text = re.sub(r".*@", "***@", text, flags=re.DOTALL)
    return re.sub(r"(://[^\s/:\[]*):(?!\d{1,5}(?!\w))[^\s/,'\"]+", r"\1:***", text)


def write_text(path: Path, text: str, *, make_folder: bool = False) -> None:
    """Write a file in UTF-8, atomically: after a failure the old file is unchanged, and no part of the new one remains.

    Args:
        path: Path of the file, which is replaced if it exists.
        text: Contents of the file.
        make_folder: True to create a missing folder.

    Raises:
        UserError: The file cannot be written.
    """
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_file():  # a device or a pipe, which cannot be replaced
            path.write_text(text, encoding="utf-8", newline="")
        else:
            _replace(path.resolve(), text)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def _replace(path: Path, text: str) -> None:
    """Write a file under another name, then rename it. The permissions of an existing file remain.

    Raises:
        OSError: The file cannot be written.
    """
    new_path = path.with_name(f".{path.name}.new")
    try:
        new_path.write_text(text, encoding="utf-8", newline="")
        if path.exists():
            shutil.copymode(path, new_path)
        new_path.replace(path)
    finally:
        new_path.unlink(missing_ok=True)
