"""``record`` as a program: received bytes are in the file, however the recorder ends."""

import contextlib
import json
import re
import signal
import subprocess
import time

import numpy as np
import pytest

from bms_estimator.cli.main import main
from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.sources.captures.capture_records import RECORD_OVERHEAD_BYTES
from bms_estimator.sources.captures.raw_capture import MAGIC, read_capture, read_header
from tests.command_line import PROGRAM
from tests.patience import LONG_S
from tests.serial_line import Line

LENGTH_AT = 8
DATA_AT = 12
"""Position in a record, after time and length [bytes]."""
TEXT = b"3.900,1.000,25.0\r\n"


@contextlib.contextmanager
def program(*arguments, **options):
    command = [PROGRAM, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def board():
    """Path of a simulated board. At its 100 samples per second the line holds two seconds for a recorder that waits."""
    with program("simulate", "--load", "constant") as process:
        yield process.stdout.readline().strip()


def until(condition, what):
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end_s, f"{what} did not come"
        time.sleep(0.02)


def size(path):
    return path.stat().st_size if path.exists() else 0


def reads(path):
    return [read for batch in read_capture(path) for read in batch]


def samples(path):
    """Return the samples of a decoder that receives the complete reads."""
    decoder = FrameDecoder()
    return sum(decoder.feed(arrival_s, data).size for arrival_s, data in reads(path))


def long_enough(path):
    """Return whether a growing capture holds a second's samples."""
    return size(path) > 1_000 and samples(path) >= 100


def replayed(capsys, path):
    """Exit code, summary, stderr of a replay."""
    with pytest.raises(SystemExit) as ended:
        main(["replay", str(path), "--cell", "chen_mora", "--json"])
    out, err = capsys.readouterr()
    return ended.value.code or 0, json.loads(out), err


def test_every_byte_of_the_line_is_in_the_file_and_ctrl_c_ends_it(line: Line, tmp_path, capsys):
    out = tmp_path / "line.bms"
    line.plug()
    with program("record", out, "--port", line.path, "--text", "--baud", 115200) as process:
        while "port opened" not in (said := process.stderr.readline()):
            assert said, "the recorder has ended"
        sent = b""
        for part in 10 * (TEXT[:7], TEXT[7:]):  # no line comes in one read
            line.write(part)
            sent += part
            until(lambda sent=sent: b"".join(data for _, data in reads(out)) == sent, f"byte {len(sent)}")
        process.send_signal(signal.SIGINT)
        said, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, said) == (0, "")
    assert re.search(r"^\d+\.\d s, 180 bytes, 10 frames, 0 lost, 0 CRC errors, 0 other faults$", err, re.MULTILINE)
    header = read_header(out)
    assert (header.mode, header.port, header.baud) == ("text", str(line.path), 115200)
    arrivals_s = [arrival_s for arrival_s, _ in reads(out)]
    assert arrivals_s == sorted(arrivals_s)
    code, result, err = replayed(capsys, out)
    assert (code, err) == (0, "")
    assert result["samples"] + sum(result["dropped"].values()) == 10


def test_a_recorder_that_is_killed_leaves_all_to_the_last_whole_record(board, tmp_path, capsys):
    out, cut = tmp_path / "killed.bms", tmp_path / "cut.bms"
    with program("record", out, "--port", board) as process:
        until(lambda: long_enough(out), "a second")
        process.kill()
        process.wait(LONG_S)
    code, result, err = replayed(capsys, out)
    assert (code, err) == (0, "")
    assert result["samples"] == samples(out) >= 100
    assert result["gaps"] == 0

    whole = reads(out)
    for cut_bytes in (1, 3, len(whole[-1][1]) + 10):  # within the checksum, the data, the record's head
        cut.write_bytes(out.read_bytes()[:-cut_bytes])
        assert reads(cut) == whole[:-1]
        code, result, err = replayed(capsys, cut)
        assert code == 0
        assert err.endswith(" bytes are no complete record: truncated, or a length is damaged\n")
        assert result["samples"] == samples(cut) > 50


@pytest.fixture(scope="module")
def recorded(board, tmp_path_factory):
    """A capture of a second or more."""
    out = tmp_path_factory.mktemp("recorded") / "one.bms"
    with program("record", out, "--port", board) as process:
        until(lambda: long_enough(out), "a second")
        process.send_signal(signal.SIGINT)
        said, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, said) == (0, "")
    counts = re.search(r" bytes, ([\d,]+) frames, 0 lost, 0 CRC errors, 0 other faults\n$", err)
    assert counts
    assert int(counts[1].replace(",", "")) == samples(out) >= 100
    return out


def test_it_ends_by_itself_after_the_seconds(board, tmp_path):
    with program("record", tmp_path / "short.bms", "--port", board, "--seconds", 0.1) as process:
        _, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0
    assert re.search(r" 0 lost, 0 CRC errors, 0 other faults\n$", err)
    assert reads(tmp_path / "short.bms")


def test_the_samples_are_those_the_board_sent(recorded, tmp_path, capsys):
    table = tmp_path / "one.csv"
    with pytest.raises(SystemExit):
        main(["replay", str(recorded), "--cell", "chen_mora", "--out", str(table)])
    capsys.readouterr()
    times = np.loadtxt(table, delimiter=",", skiprows=1, usecols=0)
    assert times.size == samples(recorded)
    assert np.allclose(np.diff(times), 1 / 100, rtol=0.0, atol=1e-5)


def test_a_damaged_record_is_said_and_what_is_before_it_is_read(recorded, tmp_path, capsys):
    damaged, whole = tmp_path / "damaged.bms", reads(recorded)
    middle = len(whole) // 2
    data = bytearray(recorded.read_bytes())
    data[-sum(RECORD_OVERHEAD_BYTES + len(read) for _, read in whole[middle:]) + DATA_AT] ^= 0xFF
    damaged.write_bytes(data)
    assert reads(damaged) == whole[:middle]
    code, result, err = replayed(capsys, damaged)
    assert code == 0
    assert f"warning: {damaged}: damaged after" in err
    assert result["samples"] == samples(damaged) > 10


def test_a_damaged_length_does_not_lose_the_rest_in_silence(recorded, tmp_path, capsys):
    damaged, whole = tmp_path / "damaged.bms", reads(recorded)
    middle = len(whole) // 2
    data = bytearray(recorded.read_bytes())
    unread = sum(RECORD_OVERHEAD_BYTES + len(read) for _, read in whole[middle:])
    data[-unread + LENGTH_AT + 1] ^= 0xFF
    damaged.write_bytes(data)
    code, _, err = replayed(capsys, damaged)
    assert code == 0
    assert f"the last {unread:,} bytes are no complete record" in err


def test_an_existing_file_is_left_as_it_is(tmp_path):
    out = tmp_path / "kept.bms"
    out.write_bytes(b"kept")
    with program("record", out, "--port", "/dev/none") as process:
        said, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, said) == (2, "")
    assert err == f"error: {out}: exists already; a capture is never overwritten\n"
    assert out.read_bytes() == b"kept"


def test_a_disk_that_is_full_ends_it_and_what_is_there_can_be_replayed(board, tmp_path, capsys):
    out = tmp_path / "full.bms"
    limit = ["bash", "-c", 'ulimit -f 4; exec "$0" "$@"']  # 4 KiB
    command = [*limit, PROGRAM, "record", out, "--port", board]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S, check=False)
    assert ended.returncode == 2
    assert "error: recording ended: File too large\n" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert size(out) <= 4 * 1024
    code, result, err = replayed(capsys, out)
    assert code == 0
    assert result["samples"] == samples(out) > 10
    head = len(MAGIC) + 4 + int.from_bytes(out.read_bytes()[len(MAGIC) :][:4], "little") + 2
    unread = size(out) - head - sum(RECORD_OVERHEAD_BYTES + len(data) for _, data in reads(out))
    said = f"warning: {out}: the last {unread:,} bytes are no complete record"
    assert (said in err) == (unread > 0)  # the limit may lie between two records


def test_a_board_that_is_not_there_is_said(tmp_path):
    with program("record", tmp_path / "none.bms", "--port", tmp_path / "none") as process:
        assert f"waiting for {tmp_path / 'none'}: it does not exist" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 0
    assert "0 bytes, 0 frames" in err
    assert reads(tmp_path / "none.bms") == []
