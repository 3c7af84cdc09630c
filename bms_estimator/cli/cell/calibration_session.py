"""Input of a calibration: captures, OCV curves, the cell that supplies what they do not determine, and files of a guided test.

A small state file names the recordings of a guided test.
"""

import gzip
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bms_estimator.model.arrays import SAMPLE, SampleBlock
from bms_estimator.model.columns import Columns
from bms_estimator.model.config_file import write_text
from bms_estimator.model.errors import UserError
from bms_estimator.settings.sensor import SensorSettings
from bms_estimator.sources.captures.raw_capture import read_capture
from bms_estimator.sources.captures.replay import RawCapture


@dataclass(frozen=True)
class Session:
    """Guided test in progress.

    Attributes:
        folder: Folder of the recordings.
        stem: Beginning of the files' names.
        plan: Name of the guided test.
        pack: Name and size of the pack, as text.
        recordings: Names of the recordings, in the order of time.
    """

    folder: Path
    stem: str
    plan: str
    pack: str
    recordings: tuple[str, ...] = ()

    @property
    def state_file(self) -> Path:
        """File with the state of the session."""
        return self.folder / f"{self.stem}.calibration.json"

    @property
    def paths(self) -> list[Path]:
        """Existing recordings."""
        return [path for name in self.recordings if (path := self.folder / name).exists()]

    def with_next_recording(self) -> tuple["Session", Path]:
        """Return the session with a further recording, and the path of this recording. The state file is written."""
        number = len(self.recordings) + 1
        while (path := self.folder / f"{self.stem}-{number}.bms").exists():
            number += 1
        session = replace(self, recordings=(*self.recordings, path.name))
        state = {"test": self.plan, "pack": self.pack, "recordings": session.recordings}
        write_text(session.state_file, json.dumps(state) + "\n")
        return session, path

    def write_capture(self, capture: Columns) -> Path:
        """Write the capture of the whole test as a table, which ``calibrate`` and other commands read; return its path."""
        path = self.folder / f"{self.stem}-test.csv.gz"
        names = ("time_s", "current_a", "voltage_v", "temperature_c")
        with gzip.open(path, "wt") as text:
            np.savetxt(
                text,
                np.column_stack([capture[name] for name in names]),
                fmt=("%.3f", "%.6g", "%.6g", "%.4g"),
                delimiter=",",
                header=",".join(names),
                comments="",
            )
        return path

    def end(self) -> None:
        """Delete the state file. The recordings remain."""
        self.state_file.unlink(missing_ok=True)


def open_session(out: Path, plan: str, pack: str, *, restart: bool) -> Session:
    """Return the interrupted session beside a cell file, or a new one.

    Args:
        out: Cell file to write.
        plan: Name of the guided test.
        pack: Name and size of the pack, as text.
        restart: Begin a new session, and ignore an interrupted one.

    Raises:
        UserError: The state file is damaged, or the interrupted session has another test or pack.
    """
    new = Session(out.parent, out.stem, plan, pack)
    if restart or not new.state_file.exists():
        return new
    try:
        state = json.loads(new.state_file.read_text())
        recordings, interrupted_plan = tuple(map(str, state["recordings"])), str(state["test"])
        interrupted_pack = str(state.get("pack", pack))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"{new.state_file}: cannot be read; --restart begins a new calibration") from None
    if interrupted_plan != plan:
        raise UserError(
            f"{new.state_file}: a {interrupted_plan} test was interrupted; continue it with "
            f"--test {interrupted_plan}, or begin a new one with --restart"
        )
    if interrupted_pack != pack:
        raise UserError(
            f"{new.state_file}: a test of another pack or with other settings was interrupted ({interrupted_pack}; now "
            f"{pack}); give another --out, or begin a new test with --restart"
        )
    return replace(new, recordings=recordings)


def join_recordings(paths: list[Path], sensor: SensorSettings) -> tuple[SampleBlock, float]:
    """Return the samples of successive recordings on one clock, and the arrival time of the last [s since 1970].

    Recordings that a power failure ended before the first sync are left out. Each recording begins at time 0. The gap
    between two recordings follows from the arrival times of their samples. The arrival time is NaN without samples.
    """
    parts, end_s, last_arrival_s = [np.zeros(0, dtype=SAMPLE)], 0.0, math.nan
    for path in paths:
        if _is_unwritten(path):
            continue
        blocks = list(RawCapture(path, sensor))
        arrivals_s = [batch.arrivals_s for batch in read_capture(path) if batch.arrivals_s.size]
        if not blocks or not arrivals_s:
            continue
        part = np.concatenate(blocks)
        part["time_s"] += start_time(end_s, last_arrival_s, float(arrivals_s[0][0])) - part["time_s"][0]
        parts.append(part)
        end_s, last_arrival_s = float(part["time_s"][-1]), float(arrivals_s[-1][-1])
    return np.concatenate(parts), last_arrival_s


def _is_unwritten(path: Path) -> bool:
    """Return True for a recording that a power failure ended before the first sync: it is empty, or has zeros only."""
    with path.open("rb") as file:
        return not file.read(1).strip(b"\0")


def start_time(end_s: float, last_arrival_s: float, first_arrival_s: float) -> float:
    """Return the time at which a recording begins on the joint clock [s], at least 1 ms after ``end_s``: times must increase.

    Args:
        end_s: Time of the last sample before, on the joint clock [s].
        last_arrival_s: Arrival time of that sample [s since 1970]; NaN without such a sample.
        first_arrival_s: Arrival of the first sample of the recording [s since 1970].
    """
    return 0.0 if math.isnan(last_arrival_s) else end_s + max(first_arrival_s - last_arrival_s, 1e-3)
