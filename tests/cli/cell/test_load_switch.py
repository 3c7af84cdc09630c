"""Switch of the load by a program."""

import asyncio
from pathlib import Path

import pytest

from bms_estimator.cli.cell.load_switch import LoadSwitch, relay_program
from bms_estimator.model.errors import UserError
from tests.patience import LONG_S, end


def program(folder: Path, text: str) -> str:
    path = folder / "relay"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


async def test_the_program_is_called_with_each_change_and_at_the_end(tmp_path) -> None:
    calls = tmp_path / "calls"
    switch = LoadSwitch(relay_program(program(tmp_path, f'echo "$1" >> {calls}')), repeat=False)
    running = asyncio.create_task(switch.run())
    async with asyncio.timeout(LONG_S):
        while not calls.exists():  # noqa: ASYNC110 - a file has no event
            await asyncio.sleep(0.01)
        switch.request(on=True)
        while calls.read_text() != "off\non\n":  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    await end(running)
    await switch.release()
    assert calls.read_text() == "off\non\noff\n"


@pytest.mark.parametrize("command", ["/no/such", "{folder}", "{file}", "'unfinished", " "])
def test_a_program_that_cannot_be_run_is_an_error(tmp_path, command) -> None:
    file = tmp_path / "text"
    file.write_text("#!/bin/sh\n")
    with pytest.raises(UserError, match="--relay-command"):
        relay_program(command.format(folder=tmp_path, file=file))


async def test_a_load_that_cannot_be_disconnected_is_an_error(tmp_path) -> None:
    switch = LoadSwitch(relay_program(program(tmp_path, '[ "$1" = on ]')), repeat=False)
    await switch.release()  # it was never connected
    switch.request(on=True)
    running = asyncio.create_task(switch.run())
    async with asyncio.timeout(LONG_S):
        while switch.error:  # noqa: ASYNC110 - the switch has no event for a success
            await asyncio.sleep(0.01)
    await end(running)
    with pytest.raises(UserError, match=r"could not be disconnected: .* off: exit code 1; disconnect it now"):
        await switch.release()
