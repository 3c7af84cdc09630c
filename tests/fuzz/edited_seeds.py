"""Hypothesis strategies that edit seed inputs: splices of bytes and text, and replaced JSON values."""

import copy
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

SEEDS = Path(__file__).parents[1] / "data" / "fuzz"
MAX_EDITS = 4
"""Maximum number of edits of one input."""
MAX_OFFSET = 1 << 17
"""Maximum offset of an edit before the modulo by the input's length [bytes]; longer than every seed."""
MAX_REMOVED = 32
"""Maximum length of a removed piece [bytes]."""
MAX_COPIED = 64
"""Maximum length of a piece copied from a seed [bytes]."""
NUMBERS = (b"1e308", b"-1e308", b"1e999", b"nan", b"-inf", b"3_9", "٣".encode(), b"0x1F", b"-0", b"0", b"1" * 400)
TOKENS = (*NUMBERS, b"true", b"\0", b"\xff", b"\n", b"\r\n", b",", b"=", b'"', b"[" * 40, b"{", b"}", b"_", b"#")
JSON_VALUES: SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=4,
)
NO_INPUTS: SearchStrategy[bytes] = st.nothing()

Test = Callable[..., None]
Keys = tuple[Any, ...]
"""Keys and indices from a JSON value to one inside it."""


def seeds(name: str) -> list[bytes]:
    """Return the stored inputs of a reader. They include every input that has failed before."""
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
        repair: Corrects checksums; half of the edited seeds are repaired.
        others: Further inputs.
    """
    stored = seeds(name)
    edited_inputs = edited(stored, tokens)
    inputs = edited_inputs | (edited_inputs.map(repair) if repair else others)

    def decorate(test: Test) -> Test:
        for data in stored:
            test = example(data)(test)
        return given(inputs)(test)

    return decorate


def edited(stored: Sequence[bytes], tokens: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Return a strategy of seeds with up to four splices; in seeds of JSON objects values are also replaced."""
    seed = st.sampled_from(stored)
    copied = st.builds(
        lambda data, begin, length: data[begin % (len(data) + 1) :][:length],
        *(seed, st.integers(0, MAX_OFFSET), st.integers(0, MAX_COPIED)),
    )
    text = st.text(max_size=4).map(lambda characters: characters.encode("utf-8", "surrogatepass"))
    piece = st.sampled_from((*TOKENS, *tokens)) | st.binary(max_size=8) | text | copied
    splice = st.tuples(st.integers(0, MAX_OFFSET), st.none() | st.integers(0, MAX_REMOVED), piece)
    inputs = st.builds(spliced, seed, st.lists(splice, min_size=1, max_size=MAX_EDITS))
    objects = [value for data in stored if isinstance(value := parsed(data), dict)]
    return inputs | json_edited(objects) if objects else inputs


def spliced(data: bytes, splices: Sequence[tuple[int, int | None, bytes]]) -> bytes:
    """Return ``data`` after splices of offset, removed bytes and inserted piece; None: overwrite."""
    for offset, removed, piece in splices:
        begin = offset % (len(data) + 1)
        data = data[:begin] + piece + data[begin + (len(piece) if removed is None else removed) :]
    return data


def parsed(data: bytes) -> Any:
    """Return the JSON value of ``data``; None if it has none."""
    try:
        return json.loads(data)
    except ValueError:
        return None


def json_edited(objects: Sequence[Any]) -> SearchStrategy[bytes]:
    """Return a strategy of JSON objects in which one value is replaced; a newline ends a line of a text protocol."""
    places = [(value, keys) for value in objects for keys in inner_keys(value)]
    return st.builds(
        lambda place, new: json.dumps(replaced(*place, new)).encode() + b"\n", st.sampled_from(places), JSON_VALUES
    )


def inner_keys(value: Any) -> Iterator[Keys]:
    """Yield the keys of a JSON value and of all values inside it."""
    yield ()
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        for keys in inner_keys(child):
            yield key, *keys


def replaced(value: Any, keys: Keys, new: Any) -> Any:
    """Return a copy of a JSON value in which the value at ``keys`` is ``new``."""
    if not keys:
        return new
    changed = copy.copy(value)
    changed[keys[0]] = replaced(value[keys[0]], keys[1:], new)
    return changed
