"""What is done before a worker connects, so that nothing stops it later."""

from bms_estimator.fleet import warm_up
from bms_estimator.fleet.warm_up import load_fleet_kernels
from bms_estimator.kernels import flow, hour, sparse, window


def test_a_block_and_the_row_of_an_hour_go_through_all_kernels(monkeypatch) -> None:
    made = []
    take = warm_up.Partition.take
    monkeypatch.setattr(warm_up.Partition, "take", lambda *args: made.append(take(*args)) or made[-1])
    load_fleet_kernels()
    assert all(each.state and each.parameters for each in made)
    assert len(made[-1].hours) == 1
    for kernel in (sparse.pack, sparse.unpack, flow.add_flow, hour.add_rows, window.add_window):
        assert len(kernel.signatures) == 1  # each for one kind of arguments: nothing else is compiled later
