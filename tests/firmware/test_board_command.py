"""Command ``bms-estimator board`` with the firmware in simavr: calibration, gains and serial number."""

from pathlib import Path

import pytest

from bms_estimator.protocols.firmware.frame_decoder import FrameDecoder
from bms_estimator.protocols.firmware.messages import hello_command, set_bandgap_command
from bms_estimator.sources.serial import device_detection
from tests.command_line import run
from tests.firmware.host import Host
from tests.patience import LONG_S
from tests.simavr_board import SimavrBoard, write_readings

pytestmark = pytest.mark.usefixtures("firmware")


def mean_values(host: Host) -> tuple[float, float]:
    """Return the mean voltage [V] and current [A] of the next fifty samples."""
    host.next_samples(1)  # another reader may have taken the beginning of this frame
    host.send(hello_command())
    hello = host.next_hello()
    block = FrameDecoder().feed(0.0, b"".join([hello.encode(), *(s.encode() for s in host.next_samples(50))]))
    return block["voltage_v"].mean(), block["current_a"].mean()


def test_board_with_a_wrong_bandgap_is_calibrated_by_the_voltage_at_aref(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", LONG_S)
    monkeypatch.setattr(device_detection, "REFERENCE_TIMEOUT_S", LONG_S)
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 2.5, 22.2, 25.0)])
    with SimavrBoard(readings, avcc_mv=4750) as board, Host(board.path) as host:
        assert host.send_command(set_bandgap_command(1.02)).value == 1_020_000
        # the voltage has the error of the bandgap, whose true value is 1.1 V; a ratiometric current sensor needs no bandgap
        assert mean_values(host) == pytest.approx((22.2 * 1.02 / 1.1, 2.5), rel=5e-3)
        code, out, err = run(capsys, "board", board.path, "--aref-v", "4.75", "--serial", "77")
        assert (code, err) == (0, "")
        assert "bandgap: was 1.0200 V, now 1." in out
        assert "serial: was 00000000, now 0000004d" in out
        assert mean_values(host) == pytest.approx((22.2, 2.5), rel=5e-3)
        hello = host.hellos[-1][1]
    assert hello.bandgap_uv == pytest.approx(1_100_000, rel=1e-3)
    assert hello.serial == 77


def test_configured_divider_and_slope_are_stored_and_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_detection, "BOOT_TIMEOUT_S", LONG_S)
    readings = write_readings(tmp_path / "readings.csv", [(0.0, 2.5, 20.0, 25.0)])
    with SimavrBoard(readings) as board, Host(board.path) as host:
        code, out, err = run(capsys, "board", board.path, "--divider", "5", "--volts-per-ampere", "0.05", "--absolute")
        assert (code, err) == (0, "")
        assert "divider: was 6.1, now 5\n" in out
        assert "current: was 0.1 V/A at 5 V, ratiometric, now 0.05 V/A\n" in out
        # the simulated board still has a divider of 6.1 and a slope of 0.1 V/A
        assert mean_values(host) == pytest.approx((20.0 * 5.0 / 6.1, 5.0), rel=5e-3)
