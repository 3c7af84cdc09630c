"""Registry of packs: rows and cell files, and the settings and model of each pack.

Packs with equal rows share one settings object and one model, which are created on first use. A pack whose row has an error is
unknown; ``PackRegistry.reason`` returns the error.
"""

from collections.abc import Collection, Iterator
from functools import lru_cache

from bms_estimator.fleet.packs.pack_row import PackSpec, decode_row, model_of, settings_of, shipped_cell_names
from bms_estimator.fleet.packs.pack_type import type_estimator
from bms_estimator.fleet.packs.table_change import PackSource
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import PackModel
from bms_estimator.settings.pack import Settings

MAX_CACHED_SPECS = 1024
"""Maximum number of cached specifications. Many packs share one."""

UNKNOWN_PACK = "not in the table of packs; add a row and load it with `bms-estimator fleet packs load`"


class PackRegistry:
    """Registry of rows and cell files. A call returns settings and model of a pack.

    Attributes:
        rows: Row of each pack.
        cell_files: Each cell file by its name.
    """

    def __init__(self) -> None:
        self.rows = dict[str, bytes]()
        self._shared_rows = dict[bytes, bytes]()  # one object for all packs with equal rows
        self.cell_files = dict[str, bytes]()
        self._parse = lru_cache(MAX_CACHED_SPECS)(_parse_row)
        self._model = lru_cache(MAX_CACHED_SPECS)(_make_model)

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[str]:
        return iter(self.rows)

    def __contains__(self, pack: object) -> bool:
        return pack in self.rows

    def __call__(self, pack: str) -> tuple[Settings, PackModel] | None:
        """Return settings and model; None if the pack is unknown. Packs with equal rows share these objects."""
        result = self._look_up(pack)
        return None if isinstance(result, str) else result

    def source(self, pack: str) -> PackSource | None:
        """Return the row and the cell file of a pack; None if the pack is unknown."""
        spec = self.parsed_row(pack)
        if not isinstance(spec, PackSpec) or self(pack) is None:
            return None
        return PackSource(self.rows[pack].decode(), self.cell_file(spec.cell))

    def resolve(self, source: PackSource) -> tuple[Settings, PackModel] | None:
        """Return settings and model of a row and a cell file; None if they have an error."""
        spec = self._parse(source.row.encode())
        result = spec if isinstance(spec, str) else self._model(spec, source.cell_file)
        return None if isinstance(result, str) else result

    def reason(self, pack: str) -> str:
        """Return the reason for which a pack is unknown; empty if the pack is known."""
        result = self._look_up(pack)
        return result if isinstance(result, str) else ""

    def parsed_row(self, pack: str) -> PackSpec | str | None:
        """Return a pack's specification, or the error in its row; None without a row."""
        data = self.rows.get(pack)
        return None if data is None else self._parse(data)

    def cell_file(self, name: str) -> str | None:
        """Return the text of a cell file; None if it is missing or not used, because a shipped cell has this name."""
        file = None if name in shipped_cell_names() else self.cell_files.get(name)
        return None if file is None else file.decode(errors="replace")

    def set_row(self, pack: str, data: bytes | None) -> bool:
        """Set or remove (None) a pack's row. Return True if the row has changed."""
        if data == self.rows.get(pack):
            return False
        if data is None:
            del self.rows[pack]
        else:
            self.rows[pack] = self._shared_rows.setdefault(data, data)
        return True

    def set_cell(self, name: str, file: bytes | None) -> bool:
        """Set or remove (None) a cell file. Return True if the file has changed."""
        if file == self.cell_files.get(name):
            return False
        if file is None:
            del self.cell_files[name]
        else:
            self.cell_files[name] = file
        return True

    def packs_using(self, cells: Collection[str]) -> set[str]:
        """Return the packs that use one of ``cells``."""
        packs = set[str]()
        for pack, data in self.rows.items() if cells else ():
            spec = self._parse(data)
            if not isinstance(spec, str) and spec.cell in cells:
                packs.add(pack)
        return packs

    def _look_up(self, pack: str) -> tuple[Settings, PackModel] | str:
        """Return settings and model of a pack, or the reason for which it is unknown."""
        spec = self.parsed_row(pack)
        if spec is None:
            return UNKNOWN_PACK
        if isinstance(spec, str):
            return f"its row is wrong: {spec}"
        return self._model(spec, self.cell_file(spec.cell))


def _parse_row(data: bytes) -> PackSpec | str:
    try:
        return decode_row(data)
    except ValueError as error:
        return str(error)


def _make_model(spec: PackSpec, cell_file: str | None) -> tuple[Settings, PackModel] | str:
    try:
        settings, model = settings_of(spec), model_of(spec, cell_file)
        type_estimator(settings, model)  # raises an error for invalid values; the result is cached for the partitions
    except UserError as error:
        return str(error)
    except (ValueError, ArithmeticError) as error:
        return f"its values allow no estimator: {error}"
    return settings, model
