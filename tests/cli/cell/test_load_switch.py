"""Switch of the load by a program."""

import asyncio
from pathlib import Path

import pytest

from bms_estimator.cli.cell.load_switch import LoadSwitch, relay_program
from bms_estimator.model.errors import UserError
from bms_estimator.process.runtime import end_tasks
from tests.patience import until


def program(folder: Path, text: str) -> str:
    path = folder / "relay"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


async def test_the_program_is_called_with_each_change_and_at_the_end(tmp_path) -> None:
    calls = tmp_path / "calls"
    switch = LoadSwitch(relay_program(program(tmp_path, f'echo "$1" >> {calls}')), repeat=False)
    running = asyncio.create_task(switch.run())
    await until(calls.exists)
    switch.request(on=True)
    await until(lambda: calls.read_text() == "off\non\n")
    await end_tasks(running)
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
    await until(lambda: not switch.error)
    await end_tasks(running)
    with pytest.raises(UserError, match=r"could not be disconnected: .* off: exit code 1; disconnect it now"):
        await switch.release()
