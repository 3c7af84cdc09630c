"""Readers of files with edited content raise nothing but user errors, which name the file."""

import binascii
import gzip
import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from bms_estimator.checkpoint.state_files import CheckpointFile
from bms_estimator.model.cell import load_cell
from bms_estimator.model.errors import UserError
from bms_estimator.model.pack_model import load_model
from bms_estimator.settings.pack import Settings, load_settings
from bms_estimator.sources.captures.curves import read_curve
from bms_estimator.sources.captures.raw_capture import MAGIC
from bms_estimator.sources.captures.replay import load_capture
from bms_estimator.sources.serial.port_list import KnownBoardFile
from tests.fuzz.edited_seeds import SEEDS, edit, edited_seeds

TOML_TOKENS = (
    b"[pack]\n",
    b"[sensor]\n",
    b"[cell]\n",
    b"[ocv]\n",
    b"capacity_ah = true\n",
    b"[[pack]]\n",
    b"= [",
    b'"""',
)
CELL = load_cell("ncr18650")
ARRAY_HEADER = (b"{'descr':", b"'|O'", b"'<f8'", b"(1,)")
DOUBLES = st.floats() | st.sampled_from((0.0, -1.0, 1e308, 1e-308))


def load_file(path: Path, load: Callable[[Path], object], data: bytes) -> None:
    """Load a file with the content ``data``. The only permitted exception is a user error that names the file."""
    path.write_bytes(data)
    try:
        load(path)
    except UserError as error:
        assert path.name in str(error)  # noqa: PT017


def with_capture_header(data: bytes) -> bytes:
    """Correct length and CRC of a capture's header."""
    _, brace, rest = data.partition(b"{")
    header, end, crc_and_reads = rest.partition(b"}")
    text = brace + header + end
    crc = binascii.crc_hqx(text, 0xFFFF).to_bytes(2, "little")
    return MAGIC + len(text).to_bytes(4, "little") + text + crc + crc_and_reads[2:]


def with_edited_sheet(sheet: bytes) -> bytes:
    """Return the workbook of the seeds in which the sheet is replaced by these bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(SEEDS / "workbook" / "seed.xlsx") as seed, zipfile.ZipFile(content, "w") as file:
        for name in seed.namelist():
            file.writestr(name, sheet if "sheet1" in name else seed.read(name))
    return content.getvalue()


def with_doubles(array: bytes, doubles: dict[int, float]) -> bytes:
    """Overwrite doubles of a stored array, given by their index modulo the number of doubles."""
    changed = bytearray(array)
    for index, value in doubles.items():
        struct.pack_into("<d", changed, 8 * (index % (len(array) // 8)), value)
    return bytes(changed)


def checkpoints() -> SearchStrategy[bytes]:
    """Return a strategy of checkpoints in which one file of the archive is edited and all CRCs are correct."""
    with zipfile.ZipFile(SEEDS / "checkpoint" / "seed.npz") as seed:
        members = {name: seed.read(name) for name in seed.namelist()}
    doubles = st.dictionaries(st.integers(0, 1 << 16), DOUBLES, min_size=1, max_size=8)

    def archive(name: str, member: bytes) -> bytes:
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as file:
            for other_name, unchanged in members.items():
                file.writestr(other_name, member if other_name == name else unchanged)
        return content.getvalue()

    def edited_member(name: str) -> SearchStrategy[bytes]:
        arrays = edit([members[name]], ARRAY_HEADER) | st.builds(with_doubles, st.just(members[name]), doubles)
        return st.builds(archive, st.just(name), arrays)

    # Half of the checkpoints have an edited state, which contains most of the values.
    return st.sampled_from(list(members)).flatmap(edited_member) | edited_member("state.npy")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder for the files of all inputs."""
    return tmp_path_factory.mktemp("fuzz")


@edited_seeds("settings", *TOML_TOKENS)
def test_settings_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "pack.toml", load_settings, data)


@edited_seeds("cell", *TOML_TOKENS)
def test_cell_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "cell.toml", load_model, data)


@edited_seeds("csv", b"time_s", b"current_a", b"Voltage / V", b",,", b"\xef\xbb\xbf")
def test_csv_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "table.csv", load_capture, data)


@edited_seeds("csv.gz", repair=lambda data: gzip.compress(data, 1))
def test_compressed_csv_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "table.csv.gz", load_capture, data)


@edited_seeds("parquet", b"PAR1")
def test_parquet_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "table.parquet", load_capture, data)


@edited_seeds("export", b"\t", b";", b"0d 00:00:01", b"03/12/2024 1:02:03 PM", b"Volts", b"mA", b"1,5", b"\xff\xfe")
def test_reader_of_exports_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "export.txt", load_capture, data)


@edited_seeds(
    "history", b"unavailable", b"entity_id", b"last_changed", b"_value", b"2026-03-04T04:53:20Z", b"[[{", b"\\ud800"
)
def test_reader_of_histories_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "history.json", load_capture, data)


@edited_seeds("zip", b"PK\x03\x04", b"PK\x01\x02")
def test_reader_of_archives_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "export.zip", load_capture, data)


@edited_seeds("workbook", b"<row>", b"</c>", repair=with_edited_sheet)
def test_spreadsheet_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "export.xlsx", load_capture, data)


@edited_seeds("nda", b"NEWARE", b"\x55\x00\x01\x00\x00\x00")
def test_neware_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "export.nda", load_capture, data)


@edited_seeds("mpr", b"MODULE", b"VMP data  ")
def test_biologic_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "export.mpr", load_capture, data)


@edited_seeds("curve", b"soc", b"ocv_v", b"hysteresis_v", b",,")
def test_curve_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "curve.csv", read_curve, data)


@edited_seeds("capture", b"null", b'"version"', b": [", b"\\ud800", repair=with_capture_header)
def test_capture_reader_raises_only_user_errors_that_name_the_file(folder: Path, data: bytes) -> None:
    load_file(folder / "line.bms", load_capture, data)


@edited_seeds("checkpoint", b"PK\x03\x04", *ARRAY_HEADER, others=checkpoints())
def test_checkpoint_reader_raises_no_exception(folder: Path, data: bytes) -> None:
    file = CheckpointFile(folder, Settings(), CELL)
    file.path.write_bytes(data)
    file.load()


@edited_seeds("known_board")
def test_known_board_reader_raises_no_exception(folder: Path, data: bytes) -> None:
    file = KnownBoardFile(folder, "pack")
    file.path.write_bytes(data)
    file.load()
