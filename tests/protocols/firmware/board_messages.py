"""Messages of a board with the firmware's default settings, which measures 22.2 V and 2.5 A at a supply of 5 V."""

import dataclasses
from typing import Any

from bms_estimator.protocols.firmware.messages import BoardStatus, Hello, ResetCause, SampleMessage, unseal

POWER_ON_STATUS = ResetCause.POWER_ON << 4
NTC_STATUS = POWER_ON_STATUS | BoardStatus.AUX_IS_NTC
HELLO = Hello(
    *(0, 1, 0),  # firmware version, major to patch
    reset_cause=ResetCause.POWER_ON,
    boot_id=256,
    serial=0,
    sequence=0,
    board_us=0,
    rate_hz=100,
    period_ns=10_000_000,
    adc_bits=10,
    channels=1,
    divider_ppm=5_000_000,
    current_uv_per_a=100_000,
    current_zero_ppm=500_000,
    bandgap_uv=1_100_000,
    bandgap_sum=57_672,
    bandgap_count=256,
    ntc_series_ohm=10_000,
    ntc_r25_ohm=10_000,
    ntc_beta_k=3950,
).encode()
"""Frame of the hello that the board sends after power-on."""


def encode_hello(**fields: Any) -> bytes:
    """Return the frame of the default hello with some fields replaced."""
    return dataclasses.replace(Hello.decode(unseal(HELLO)), **fields).encode()


def encode_sample(number: int, board_us: int, **fields: Any) -> bytes:
    """Return the frame of sample ``number`` with time stamp ``board_us`` and some fields replaced."""
    defaults = {  # 38 readings of 22.2 V and 2.5 A, and one of the bandgap
        "voltage_sum": 34_571,
        "current_sum": 21_405,
        "count": 38,
        "aux_sum": 225,
        "aux_count": 1,
        "status": POWER_ON_STATUS,
    }
    return SampleMessage(sequence=number, board_us=board_us, **(defaults | fields)).encode()
