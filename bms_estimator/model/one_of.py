"""Validation of a string by a list of names that is available only at run time, with the name probably meant."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_after_validator_function


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
