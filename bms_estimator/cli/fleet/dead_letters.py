"""``bms-estimator fleet dead-letters``: blocks that workers could not process."""

from typing import TYPE_CHECKING, Annotated

import typer

from bms_estimator.cli.fleet.server_options import DEFAULT_SERVER, Ca, Creds, Server, on_server
from bms_estimator.cli.options.table import count_text, print_table
from bms_estimator.model.errors import UserError

if TYPE_CHECKING:
    from nats.aio.client import Client

    from bms_estimator.fleet.nats.dead_letters import DeadLetter

COLUMNS = ("pack", "stored", "sequence", "bytes", "worker", "reason")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="List or replay blocks that workers could not process.",
)


@app.command("list")
def list_letters(server: Server = DEFAULT_SERVER, creds: Creds = None, ca: Ca = None) -> None:
    """Print the stored dead letters with their reasons."""
    from bms_estimator.fleet.nats.dead_letters import read_dead_letters  # noqa: PLC0415 - NATS is optional

    letters = on_server((server, creds, ca), read_dead_letters)
    print_table(COLUMNS, [_row(letter) for letter in letters])
    if not letters:
        typer.echo("none")


@app.command()
def replay(
    packs: Annotated[
        list[str] | None, typer.Argument(help="names of packs; default: all packs", show_default=False)
    ] = None,
    server: Server = DEFAULT_SERVER,
    creds: Creds = None,
    ca: Ca = None,
) -> None:
    """Send the blocks to the workers again, and remove their dead letters.

    Workers process a block if its pack still awaits it. This is true for blocks of a version that the workers did not read before
    an upgrade. A block that killed workers was skipped, and is not processed later.
    """
    count, names = on_server((server, creds, ca), lambda nc: _replay(nc, set(packs or ())))
    packs_text = f"{count_text(len(names), 'pack')}: {', '.join(sorted(names))}"
    typer.echo(f"replayed {count_text(count, 'block')} of {packs_text}" if count else "none")


def _row(letter: "DeadLetter") -> tuple[object, ...]:
    stored = letter.time.partition(".")[0].replace("T", " ")
    return letter.pack, stored, letter.sequence, len(letter.data), letter.worker, letter.reason


async def _replay(nc: "Client", packs: set[str]) -> tuple[int, set[str]]:
    """Replay the dead letters of some packs, or of all. Return their number, and the names of their packs."""
    from bms_estimator.fleet.nats.dead_letters import read_dead_letters, replay_letter  # noqa: PLC0415

    letters = await read_dead_letters(nc)
    if missing := packs - {letter.pack for letter in letters}:
        raise UserError(f"{', '.join(sorted(missing))}: no dead letters; `fleet dead-letters list` prints all")
    chosen = [letter for letter in letters if not packs or letter.pack in packs]
    for letter in chosen:
        await replay_letter(nc, letter)
    return len(chosen), {letter.pack for letter in chosen}
