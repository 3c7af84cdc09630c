"""Table of packs that is in force at a partition's position of the stream.

A change of the table takes effect when its message in the stream is processed. Therefore each block is estimated with the same
settings, whichever worker processes it.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from bms_estimator.fleet.packs.pack_type import PackType, PackTypes
from bms_estimator.fleet.packs.table_change import PackSource, decode_change, encode_change
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.pack import Settings

PackLookup = Callable[[str], tuple[Settings, PackModel] | None]
"""Function that returns settings and model of a pack; None: the pack is unknown."""


class PackSources(Protocol):
    """Table of packs whose changes are applied in the order of the stream (``PackRegistry``)."""

    def source(self, pack: str) -> PackSource | None:
        """Return the present row and cell file of a pack; None if the pack is unknown."""

    def resolve(self, source: PackSource) -> tuple[Settings, PackModel] | None:
        """Return settings and model of a row and a cell file; None if they have an error."""


class TableInForce:
    """Table in force, and types of the packs.

    Args:
        table: Settings and models of the packs.
        sources: Rows of the same table, whose changes are applied in the order of the stream; None: a change takes effect
            at once.
        types: Types of the packs of the partition.

    Attributes:
        unchecked: Packs whose rows in the table may differ from those in force.
    """

    def __init__(self, table: PackLookup, sources: PackSources | None, types: PackTypes) -> None:
        self._table, self._sources = table, sources
        self._rows: dict[str, PackSource] = {}  # of each pack with processed blocks
        self.unchecked = set[str]()
        self._type_by_pack: dict[str, PackType] = {}
        self._types = types

    @property
    def rows(self) -> Mapping[str, PackSource]:
        """Row and cell file of each pack at this position of the stream."""
        return self._rows

    def restore(self, rows: Mapping[str, PackSource]) -> None:
        """Add the rows of a checkpoint. They are checked, because the former owner may not have sent the last changes."""
        self._rows.update(rows)
        self.unchecked.update(rows)

    def look_up(self, pack: str) -> PackType | None:
        """Return the type of a pack; None if the pack is unknown. The present row of a new pack becomes the one in force."""
        pack_type = self._type_by_pack.get(pack)
        if pack_type is None:
            settings_and_model = self._settings(pack)
            if settings_and_model is None:
                return None
            source = self._sources.source(pack) if self._sources is not None else None
            if source is not None:
                self._rows.setdefault(pack, source)
            pack_type = self._type_by_pack[pack] = self._types.of(*settings_and_model)
        return pack_type

    def is_known(self, pack: str) -> bool:
        """Return True if the pack has valid settings."""
        return self._settings(pack) is not None

    def on_table_changed(self, pack: str) -> None:
        """Check a changed or new row of the table. The row in force changes only by a message of the stream."""
        if pack not in self._rows:
            self._type_by_pack.pop(pack, None)
        self.unchecked.add(pack)

    def table_change(self, pack: str) -> bytes | None:
        """Return the message for the stream if the row of a pack in the table differs from the one in force; otherwise None."""
        if self._sources is None or pack not in self._rows:
            return None
        source = self._sources.source(pack)
        return None if source == self._rows[pack] else encode_change(source)

    def apply_change(self, pack: str, data: bytes) -> None:
        """Apply a change of a pack's row to the following blocks of the pack.

        Raises:
            ValueError: The message is damaged.
        """
        source = decode_change(data)
        if source is None:
            self._rows.pop(pack, None)
        else:
            self._rows[pack] = source
        self._type_by_pack.pop(pack, None)
        self.unchecked.add(pack)  # a later change may still have to be sent

    def _settings(self, pack: str) -> tuple[Settings, PackModel] | None:
        """Return the settings and the model in force. For a new pack, and for a row with an error, the table is read."""
        source = self._rows.get(pack)
        in_force = self._sources.resolve(source) if self._sources is not None and source else None
        return in_force or self._table(pack)
