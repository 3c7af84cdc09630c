"""Hypothesis strategies that edit stored inputs (seeds): they splice bytes and text, and replace JSON values."""

import copy
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hypothesis import example, given, strategies as st
from hypothesis.strategies import SearchStrategy

SEEDS = Path(__file__).parents[1] / "data" / "fuzz"
MAX_EDITS = 4
"""Maximum number of edits of one input."""
MAX_OFFSET = 1 << 17
"""Maximum of a drawn offset, which is reduced modulo the length of the input; larger than every seed [bytes]."""
MAX_REMOVED = 32
"""Maximum length of a removed piece [bytes]."""
MAX_COPIED = 64
"""Maximum length of a piece copied from a seed [bytes]."""
UNUSUAL_NUMBERS = (
    b"1e308",
    b"-1e308",
    b"1e999",
    b"nan",
    b"-inf",
    b"3_9",
    "٣".encode(),
    b"0x1F",
    b"-0",
    b"0",
    b"1" * 400,
)
TOKENS = (
    *UNUSUAL_NUMBERS,
    b"true",
    b"\0",
    b"\xff",
    b"\n",
    b"\r\n",
    b",",
    b"=",
    b'"',
    b"[" * 40,
    b"{",
    b"}",
    b"_",
    b"#",
)
"""Pieces to insert into an input of any format."""
JSON_VALUES: SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=4,
)
NO_INPUTS: SearchStrategy[bytes] = st.nothing()

Test = Callable[..., None]
Keys = tuple[Any, ...]
"""Keys and indices that lead from a JSON value to a value inside it."""


def load_seeds(name: str) -> list[bytes]:
    """Return the stored inputs in the folder ``name``. They include every input that has failed before."""
    return [path.read_bytes() for path in sorted((SEEDS / name).iterdir())]


def edited_seeds(
    name: str,
    *tokens: bytes,
    repair: Callable[[bytes], bytes] | None = None,
    others: SearchStrategy[bytes] = NO_INPUTS,
) -> Callable[[Test], Test]:
    """Return a decorator of a test that has one input. The test runs with all seeds, then with edited seeds.

    Args:
        name: Folder of the seeds.
        tokens: Pieces of the reader's format to insert.
        repair: Function that corrects checksums. About half of the inputs are repaired edited seeds.
        others: Further inputs, if there is no ``repair``.
    """
    stored = load_seeds(name)
    edited = edit(stored, tokens)
    inputs = edited | (edited.map(repair) if repair else others)

    def decorate(test: Test) -> Test:
        for data in stored:
            test = example(data)(test)
        return given(inputs)(test)

    return decorate


def edit(stored: Sequence[bytes], tokens: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Return a strategy of seeds with 1 to ``MAX_EDITS`` splices; JSON objects may instead have one value replaced."""
    seed = st.sampled_from(stored)
    copied = st.builds(
        lambda data, begin, length: data[begin % (len(data) + 1) :][:length],
        *(seed, st.integers(0, MAX_OFFSET), st.integers(0, MAX_COPIED)),
    )
    text = st.text(max_size=4).map(lambda characters: characters.encode("utf-8", "surrogatepass"))
    piece = st.sampled_from((*TOKENS, *tokens)) | st.binary(max_size=8) | text | copied
    splice = st.tuples(st.integers(0, MAX_OFFSET), st.none() | st.integers(0, MAX_REMOVED), piece)
    inputs = st.builds(splice_all, seed, st.lists(splice, min_size=1, max_size=MAX_EDITS))
    objects = [value for data in stored if isinstance(value := parse_json(data), dict)]
    return inputs | replace_json_values(objects) if objects else inputs


def splice_all(data: bytes, splices: Sequence[tuple[int, int | None, bytes]]) -> bytes:
    """Return ``data`` after splices of (offset, number of removed bytes, inserted piece).

    None as number means that the piece overwrites as many bytes as it has.
    """
    for offset, removed, piece in splices:
        begin = offset % (len(data) + 1)
        data = data[:begin] + piece + data[begin + (len(piece) if removed is None else removed) :]
    return data


def parse_json(data: bytes) -> Any:
    """Return the JSON value of ``data``; None if it has none."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def replace_json_values(objects: Sequence[Any]) -> SearchStrategy[bytes]:
    """Return a strategy of JSON objects in which one value, at any depth, is replaced."""
    places = [(value, keys) for value in objects for keys in inner_keys(value)]

    def replace_at(place: tuple[Any, Keys], new: Any) -> bytes:
        # The newline ends a line of a text protocol.
        return json.dumps(replace(*place, new)).encode() + b"\n"

    return st.builds(replace_at, st.sampled_from(places), JSON_VALUES)


def inner_keys(value: Any) -> Iterator[Keys]:
    """Yield the ``Keys`` of all values inside a JSON value, and empty ones for the value itself."""
    yield ()
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        for keys in inner_keys(child):
            yield key, *keys


def replace(value: Any, keys: Keys, new: Any) -> Any:
    """Return a copy of a JSON value in which the value at ``keys`` is ``new``."""
    if not keys:
        return new
    changed = copy.copy(value)
    changed[keys[0]] = replace(value[keys[0]], keys[1:], new)
    return changed
