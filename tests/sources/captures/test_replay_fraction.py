"""Progress of a replay within a block of its file."""

from pathlib import Path

import pytest

from bms_estimator.sources.captures.replay import Replay, open_capture


@pytest.mark.parametrize("options", [{"max_block_s": 1.0}, {"speed": 1e6}, {}])
async def test_the_fraction_rises_to_1_within_a_single_block(tmp_path: Path, options: dict[str, float]) -> None:
    table = tmp_path / "load.csv"
    table.write_text("time_s,current_a,voltage_v\n" + "".join(f"{second},1.0,3.9\n" for second in range(20)))
    replay = Replay(open_capture(table), **options)
    fractions = [replay.fraction async for _ in replay]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    if "max_block_s" in options:
        assert fractions == pytest.approx([second / 20 for second in range(1, 21)])
