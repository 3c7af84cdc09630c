"""Process of command ``record``: the file has all received bytes, however the process ended."""

import contextlib
import json
import re
import signal
import subprocess
import time

import numpy as np
import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.sources.captures.capture_records import RECORD_OVERHEAD_BYTES
from bms_estimator.sources.captures.raw_capture import MAGIC, read_capture, read_header
from tests.command_line import PROGRAM, run
from tests.patience import LONG_S
from tests.serial_line import Line

LENGTH_OFFSET = 8
"""Offset of the length in a record, after the time [bytes]."""
DATA_OFFSET = 12
"""Offset of the data in a record, after time and length [bytes]."""
TEXT_LINE = b"3.900,1.000,25.0\r\n"


@contextlib.contextmanager
def program(*arguments, **options):
    """Run ``bms-estimator`` as a process, which is killed at the end."""
    command = [PROGRAM, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def board():
    """Run a simulated board and yield its path. At 100 Hz the line buffers two seconds for a blocked recorder."""
    with program("simulate", "--load", "constant") as process:
        yield process.stdout.readline().strip()


def until(condition, awaited):
    """Wait until the condition is true. ``awaited`` names it in the error."""
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end_s, f"{awaited} did not arrive"
        time.sleep(0.02)


def size_bytes(path):
    """Return the size of a file; 0 if it does not exist."""
    return path.stat().st_size if path.exists() else 0


def complete_reads(path):
    """Return arrival time and bytes of each complete record."""
    return [read for batch in read_capture(path) for read in batch]


def count_samples(reads):
    """Return the number of samples in reads from the beginning of a capture."""
    decoder = FrameDecoder()
    return sum(decoder.feed(arrival_s, data).size for arrival_s, data in reads)


def sample_count(path):
    """Return the number of samples in all complete reads."""
    return count_samples(complete_reads(path))


def has_a_second(path):
    """Return True if a growing capture contains the samples of a second, and several of them in the first half of its reads."""
    if size_bytes(path) <= 1_000:
        return False
    reads = complete_reads(path)
    return count_samples(reads) >= 100 and count_samples(reads[: len(reads) // 2]) > 10


def replay(capsys, path):
    """Replay a capture. Return exit code, summary and stderr."""
    code, out, err = run(capsys, "replay", path, "--cell", "chen_mora", "--json")
    return code, json.loads(out), err


def test_all_bytes_are_recorded_until_ctrl_c(line: Line, tmp_path, capsys):
    out = tmp_path / "line.bms"
    line.plug()
    with program("record", out, "--port", line.path, "--text", "--baud", 115200) as process:
        while "port opened" not in (message := process.stderr.readline()):
            assert message, "the recorder has ended"
        sent = b""
        for piece in 10 * (TEXT_LINE[:7], TEXT_LINE[7:]):  # each line is split over two reads
            line.write(piece)
            sent += piece
            until(lambda sent=sent: b"".join(data for _, data in complete_reads(out)) == sent, f"byte {len(sent)}")
        process.send_signal(signal.SIGINT)
        message, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, message) == (0, "")
    assert re.search(r"^\d+\.\d s, 180 bytes, 10 frames, 0 lost, 0 CRC errors, 0 other faults$", err, re.MULTILINE)
    header = read_header(out)
    assert (header.mode, header.port, header.baud) == ("text", str(line.path), 115200)
    arrivals_s = [arrival_s for arrival_s, _ in complete_reads(out)]
    assert arrivals_s == sorted(arrivals_s)
    code, result, err = replay(capsys, out)
    assert (code, err) == (0, "")
    assert result["samples"] + sum(result["dropped"].values()) == 10


def test_killed_recorder_leaves_complete_records(board, tmp_path, capsys):
    out, truncated = tmp_path / "killed.bms", tmp_path / "truncated.bms"
    with program("record", out, "--port", board) as process:
        until(lambda: has_a_second(out), "a second")
        process.kill()
        process.wait(LONG_S)
    code, result, err = replay(capsys, out)
    assert (code, err) == (0, "")
    assert result["samples"] == sample_count(out) >= 100
    assert result["gaps"] == 0

    all_reads = complete_reads(out)
    for removed_bytes in (1, 3, len(all_reads[-1][1]) + 10):  # within the checksum, the data, and the record's header
        truncated.write_bytes(out.read_bytes()[:-removed_bytes])
        assert complete_reads(truncated) == all_reads[:-1]
        code, result, err = replay(capsys, truncated)
        assert code == 0
        assert err.endswith(
            " bytes are no complete record: the file is truncated, or the length in a record is damaged\n"
        )
        assert result["samples"] == sample_count(truncated) > 50


@pytest.fixture(scope="module")
def capture(board, tmp_path_factory):
    """Record at least a second of the board."""
    out = tmp_path_factory.mktemp("recorded") / "one.bms"
    with program("record", out, "--port", board) as process:
        until(lambda: has_a_second(out), "a second")
        process.send_signal(signal.SIGINT)
        message, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, message) == (0, "")
    counts = re.search(r" bytes, ([\d,]+) frames, 0 lost, 0 CRC errors, 0 other faults\n$", err)
    assert counts
    assert int(counts[1].replace(",", "")) == sample_count(out) >= 100
    return out


def test_recording_ends_after_the_duration(board, tmp_path, capsys):
    code, _, err = run(capsys, "record", tmp_path / "short.bms", "--port", board, "--seconds", 0.1)
    assert code == 0
    assert re.search(r" 0 lost, 0 CRC errors, 0 other faults\n$", err)
    assert complete_reads(tmp_path / "short.bms")


def test_replayed_samples_have_the_period_of_the_board(capture, tmp_path, capsys):
    table = tmp_path / "one.csv"
    assert run(capsys, "replay", capture, "--cell", "chen_mora", "--out", table)[0] == 0
    times = np.loadtxt(table, delimiter=",", skiprows=1, usecols=0)
    assert times.size == sample_count(capture)
    assert np.allclose(np.diff(times), 1 / 100, rtol=0.0, atol=1e-5)


def test_damaged_record_is_reported_and_earlier_ones_are_read(capture, tmp_path, capsys):
    damaged, all_reads = tmp_path / "damaged.bms", complete_reads(capture)
    middle = len(all_reads) // 2
    data = bytearray(capture.read_bytes())
    data[-sum(RECORD_OVERHEAD_BYTES + len(read) for _, read in all_reads[middle:]) + DATA_OFFSET] ^= 0xFF
    damaged.write_bytes(data)
    assert complete_reads(damaged) == all_reads[:middle]
    code, result, err = replay(capsys, damaged)
    assert code == 0
    assert f"warning: {damaged}: damaged after" in err
    assert result["samples"] == sample_count(damaged) > 10


def test_damaged_length_is_reported(capture, tmp_path, capsys):
    damaged, all_reads = tmp_path / "damaged.bms", complete_reads(capture)
    middle = len(all_reads) // 2
    data = bytearray(capture.read_bytes())
    unread = sum(RECORD_OVERHEAD_BYTES + len(read) for _, read in all_reads[middle:])
    data[-unread + LENGTH_OFFSET + 1] ^= 0xFF
    damaged.write_bytes(data)
    code, _, err = replay(capsys, damaged)
    assert code == 0
    assert f"the last {unread:,} bytes are no complete record" in err


def test_existing_file_is_not_overwritten(tmp_path, capsys):
    out = tmp_path / "kept.bms"
    out.write_bytes(b"kept")
    message = f"error: {out}: exists already; a capture is never overwritten\n"
    assert run(capsys, "record", out, "--port", "/dev/none") == (2, "", message)
    assert out.read_bytes() == b"kept"


@pytest.mark.thorough
def test_full_disk_ends_the_recording_and_the_file_is_readable(board, tmp_path, capsys):
    out = tmp_path / "full.bms"
    # 4 KiB; Python 3.11 would store modules that it compiles first cut to that size, and every later start would fail
    limit = ["bash", "-c", 'ulimit -f 4; PYTHONDONTWRITEBYTECODE=1 exec "$0" "$@"']
    command = [*limit, PROGRAM, "record", out, "--port", board]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert ended.returncode == 2
    assert "error: recording ended: File too large\n" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert size_bytes(out) <= 4 * 1024
    code, result, err = replay(capsys, out)
    assert code == 0
    assert result["samples"] == sample_count(out) > 10
    header_bytes = len(MAGIC) + 4 + int.from_bytes(out.read_bytes()[len(MAGIC) :][:4], "little") + 2
    unread = size_bytes(out) - header_bytes - sum(RECORD_OVERHEAD_BYTES + len(data) for _, data in complete_reads(out))
    message = f"warning: {out}: the last {unread:,} bytes are no complete record"
    assert (message in err) == (unread > 0)  # the limit may lie between two records


@pytest.mark.thorough
def test_missing_board_is_reported(tmp_path):
    with program("record", tmp_path / "none.bms", "--port", tmp_path / "none") as process:
        assert f"waiting for {tmp_path / 'none'}: it does not exist" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0
    assert "0 bytes, 0 frames" in err
    assert complete_reads(tmp_path / "none.bms") == []
