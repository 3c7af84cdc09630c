"""Memory that control groups leave, and whether they can limit it."""

from pathlib import Path

import pytest

from bms_estimator.process import memory


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_the_smallest_limit_of_all_control_groups_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path("/proc/self/cgroup").read_text().splitlines()[-1].split(":", 2)[2].lstrip("/")
    group = tmp_path / path / "service"
    for folder, limit in ((group, "9000"), (group.parent, "max"), (tmp_path, "8000")):
        write(folder / "memory.max", f"{limit}\n")
        write(folder / "memory.stat", "anon 3000\nfile 4000\n")
    limits = memory._available_in_parents(tmp_path, f"/{path}/service", "memory.max", "anon")
    assert min(limits) == 5000


def test_this_process_has_memory_on_this_machine() -> None:
    assert 0 < memory.anonymous_bytes() < memory.available_bytes() + memory.anonymous_bytes()


@pytest.mark.parametrize(("controllers", "limits"), [("cpu io memory pids", True), ("cpu io pids", False)])
def test_memory_is_limited_only_with_its_controller(tmp_path: Path, controllers: str, limits: bool) -> None:
    write(tmp_path / "cgroup.controllers", f"{controllers}\n")
    assert memory.has_memory_groups(tmp_path) is limits
