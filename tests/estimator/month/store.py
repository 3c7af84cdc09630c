"""Files of simulated samples with the true SOC, as input of experiments outside the tests."""

from pathlib import Path

import numpy as np

from tests.estimator.month.cases import Case


def save(case: Case, folder: Path, data: Path) -> Path:
    """Write samples, true SOC and true capacity of a case as columns of one .npz file, and return its path.

    The file also contains chemistry, declared capacity [Ah] and step [s].
    """
    recording = case.draw(data)
    columns = {name: recording.samples[name] for name in ("time_s", "current_a", "voltage_v", "temperature_c")}
    columns |= {name: recording.truth[name] for name in ("soc", "capacity_ah")}
    path = folder / f"{file_name(case)}.npz"
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        **columns,
        chemistry=recording.chemistry,
        declared_ah=recording.declared_ah,
        step_s=case.source.step_s,
    )
    return path


def file_name(case: Case) -> str:
    """Return a name without spaces or slashes."""
    words = "".join(c if c.isalnum() or c == "_" else "-" for c in f"{case.name}-{case.seed}")
    return "-".join(filter(None, words.split("-")))
