"""Short version of ``make fuzz``: the stored corpus and a few hundred mutated inputs for each parser."""

from collections.abc import Iterator

import pytest
import structlog

from tests.benchmarks.fuzz import TARGETS, attempt, inputs, quiet, seeds

INPUTS = 150


@pytest.fixture(autouse=True)
def log() -> Iterator[None]:
    before = structlog.get_config()
    quiet()
    yield
    structlog.configure(**before)


@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus_fails_nowhere(name: str) -> None:
    found = seeds(name)
    assert attempt(name, iter(found)) == len(found) > 0


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_fail_nowhere(name: str) -> None:
    assert attempt(name, inputs(name, "test", INPUTS)) == INPUTS


def test_the_same_seed_gives_the_same_inputs() -> None:
    assert list(inputs("frames", "1", 5)) == list(inputs("frames", "1", 5)) != list(inputs("frames", "2", 5))
