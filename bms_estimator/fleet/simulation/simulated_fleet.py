"""Simulated packs: the blocks of their edges, and the ground truth.

A block is a function of seed, pack and number. Therefore 100,000 packs need no storage, and any block can be resent. SOC is a
closed-form function of time, so that estimates can be compared with the truth at any time.

The SOC of a pack oscillates slowly, with a zero-mean current pulse each minute. The voltage follows from the shipped
cell's OCV and elements, (2.4) of the thesis, with two RC branches of fixed time constants. Capacity and resistances differ
from the values in the table of packs, because real packs age and vary.
"""

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.model.arrays import SAMPLE, Floats, SampleBlock
from bms_estimator.model.cell import CellModel, load_cell

Ints = NDArray[np.int64]
Bits = NDArray[np.uint64]

BLOCK_S = 60
"""Duration of a block [s], with one sample a second."""
MEAN_SOC = 0.52
"""Mean SOC."""
SOC_AMPLITUDE = 0.36
"""Amplitude of the SOC, which therefore stays within 0.16 to 0.88."""
SLOW_FRACTION = 0.75
"""Amplitude of the slow oscillation of SOC as a fraction of ``SOC_AMPLITUDE``."""
FAST_FRACTION = 0.25
"""Amplitude of the fast oscillation of SOC as a fraction of ``SOC_AMPLITUDE``."""
FREQUENCY_RATIO = 3.3
"""Ratio of the frequencies of the fast and the slow oscillation."""
MIN_PERIOD_S = 8 * 3600.0
"""Minimum period of the slow oscillation [s], at which the current reaches 0.43 C."""
MAX_PERIOD_S = 24 * 3600.0
"""Maximum period of the slow oscillation [s]."""
PULSE_S = 15
"""Duration of the current pulse in each minute [s]. In the remaining 45 s a third of the current flows in the opposite
direction, so that the mean is zero."""
PULSE_C = 0.6
"""Maximum current of a pulse as a C-rate [1/h]."""
PAST_PULSES = 5
"""Number of past pulses in the branch current. The current of an older pulse has decayed to less than e^(-300/20)."""
TAU_TS_S = 20.0
"""Time constant of the fast RC branch [s]."""
TAU_TL_S = 800.0
"""Time constant of the slow RC branch [s]."""
JITTER_S = 0.02
"""Maximum error of a real device's timestamps [s]."""
MIN_CAPACITY = 0.75
"""Minimum true capacity as a fraction of the rated capacity."""
MAX_CAPACITY = 1.02
"""Maximum true capacity as a fraction of the rated capacity."""
WORN_OUT_CAPACITY = 0.6
"""True capacity of a worn-out pack as a fraction of the rated capacity."""
MIN_RESISTANCE = 0.8
"""Minimum true resistance as a multiple of the cell file's resistance."""
MAX_RESISTANCE = 1.6
"""Maximum true resistance as a multiple of the cell file's resistance."""
FAILING_RESISTANCE = 3.0
"""True resistance of a failing pack as a multiple of the cell file's resistance."""
OUTLIER_FRACTION = 0.01
"""Fraction of packs that are worn out. An equal fraction is failing."""


_Draw = IntEnum(
    "_Draw",
    "STORE_DELAY PERIOD PHASE TEMPERATURE DEFECT CAPACITY RESISTANCE JITTER CURRENT_NOISE VOLTAGE_NOISE PULSE",
)
"""Random values of a pack. Each has its own stream of numbers."""


class Kind(NamedTuple):
    """Kind of pack: configured values that many packs share."""

    cell: str
    capacity_ah: float | None
    series: int
    parallel: int
    voltage_resolution_v: float
    current_resolution_a: float
    thermometer: bool


KINDS = (
    Kind("lfp", 100.0, 16, 1, 0.01, 0.1, thermometer=True),
    Kind("nmc", 10.0, 14, 2, 0.01, 0.05, thermometer=True),
    Kind("nca", 3.0, 20, 10, 0.02, 0.1, thermometer=False),
    Kind("ncr18650", None, 10, 4, 0.01, 0.02, thermometer=True),
)
"""Kinds of packs: home storage, bicycle, scooter, and a pack of the shipped cell. Each kind is a quarter of the fleet."""

COLUMNS = (
    "pack",
    "cell",
    "capacity_ah",
    "series",
    "parallel",
    "voltage_resolution_v",
    "current_resolution_a",
    "period_s",
)
"""Columns of the table of packs."""


class _Curves:
    """Curves of one kind of pack over SOC: OCV [V] and resistances [ohm] of the whole pack."""

    def __init__(self, kind: Kind) -> None:
        pack: CellModel = load_cell(kind.cell, kind.capacity_ah).pack(kind.series, kind.parallel)
        a, soc = pack.a, np.linspace(0.0, 1.0, OCV_POINTS)
        self.capacity_as = pack.cell.capacity_ah * 3600.0
        self.soc, self.ocv_v = soc, ocv_grid(pack)[0]
        self.r_s, self.r_ts, self.r_tl = (
            a[i] * np.exp(-a[i + 1] * soc) + a[i + 2]
            for i in (13, 1, 4)  # index of the first coefficient: (2.9), (2.5) and (2.6) of the thesis
        )


class SimulatedFleet:
    """Fleet of simulated packs.

    Args:
        packs: Number of packs.
        seed: Seed of all random values.
        begin_ns: Creation time of the first edge's store [ns since 1970]. The other stores follow within a minute.

    Attributes:
        names: Names of the packs.
        store_created_ns: Creation time of each edge's store [ns since 1970], shape (packs,).
        true_capacity_as: True capacity of each pack [A s], hidden from the estimators, shape (packs,).
        true_resistance: True resistances of each pack divided by those of the cell file, shape (packs,).
    """

    def __init__(self, packs: int, *, seed: int, begin_ns: int) -> None:
        pack = np.arange(packs, dtype=np.int64)
        self.names = tuple(f"sim-{i:06d}" for i in range(packs))
        self._salt = np.uint64(seed % 2**64)
        self._curves = tuple(_Curves(kind) for kind in KINDS)
        self._kind_index = pack % len(KINDS)
        store_delay_s = self._uniform(pack, _Draw.STORE_DELAY) * BLOCK_S
        self.begin_ns = begin_ns
        self.store_created_ns: Ints = begin_ns + (store_delay_s * 1e9).astype(np.int64)
        self._omega = 2.0 * math.pi / (MIN_PERIOD_S + (MAX_PERIOD_S - MIN_PERIOD_S) * self._uniform(pack, _Draw.PERIOD))
        self._phase = 2.0 * math.pi * self._uniform(pack, _Draw.PHASE)
        self._temperature_c = np.round(20.0 + 10.0 * self._uniform(pack, _Draw.TEMPERATURE), 1)
        self.true_capacity_as, self.true_resistance = self._draw_truth(pack)

    def _draw_truth(self, pack: Ints) -> tuple[Floats, Floats]:
        defect = self._uniform(pack, _Draw.DEFECT)
        capacity = MIN_CAPACITY + (MAX_CAPACITY - MIN_CAPACITY) * self._uniform(pack, _Draw.CAPACITY)
        resistance = MIN_RESISTANCE + (MAX_RESISTANCE - MIN_RESISTANCE) * self._uniform(pack, _Draw.RESISTANCE)
        capacity[defect < OUTLIER_FRACTION] = WORN_OUT_CAPACITY
        resistance[(defect >= OUTLIER_FRACTION) & (defect < 2 * OUTLIER_FRACTION)] = FAILING_RESISTANCE
        rated_as = np.array([curves.capacity_as for curves in self._curves])
        return capacity * rated_as[self._kind_index], resistance

    def kind(self, pack: int) -> Kind:
        """Return the kind of a pack as in the table of packs."""
        return KINDS[self._kind_index[pack]]

    def blocks(self, packs: Ints, numbers: Ints, arrival_s: Floats) -> Iterator[bytes]:
        """Yield one encoded block of each pack, as edges send it.

        Args:
            packs: Numbers of the packs, shape (n,).
            numbers: Numbers of the blocks, from 1.
            arrival_s: Wall clock at the arrival of each block's last sample [s since 1970].
        """
        samples = self.samples(packs, numbers)
        for i, (pack, number) in enumerate(zip(packs.tolist(), numbers.tolist(), strict=True)):
            block = Block(
                store_created_ns=int(self.store_created_ns[pack]),
                number=number,
                oldest=1,
                arrival_s=float(arrival_s[i]),
                samples=samples[i],
            )
            yield encode(block)

    def samples(self, packs: Ints, numbers: Ints) -> SampleBlock:
        """Return the samples of one block of each pack: shape (n, BLOCK_S), dtype ``SAMPLE``."""
        second = np.arange(BLOCK_S)
        index = ((numbers[:, None] - 1) * BLOCK_S + second).astype(np.int64)
        samples = np.zeros((packs.size, BLOCK_S), dtype=SAMPLE)
        samples["time_s"] = index + np.round(JITTER_S * self._uniform(packs[:, None], _Draw.JITTER, index), 3)
        samples["temperature_c"] = self._temperature_c[packs][:, None]
        for kind_index, (declared, curves) in enumerate(zip(KINDS, self._curves, strict=True)):
            rows = np.flatnonzero(self._kind_index[packs] == kind_index)
            if rows.size:
                current_a, voltage_v = self._current_and_voltage(packs[rows], numbers[rows], curves)
                # within half a step of the current, and one step of the voltage
                noise_a = self._uniform(packs[rows][:, None], _Draw.CURRENT_NOISE, index[rows]) - 0.5
                noise_v = 2.0 * (self._uniform(packs[rows][:, None], _Draw.VOLTAGE_NOISE, index[rows]) - 0.5)
                samples["current_a"][rows] = _quantize(current_a, noise_a, declared.current_resolution_a)
                samples["voltage_v"][rows] = _quantize(voltage_v, noise_v, declared.voltage_resolution_v)
                if not declared.thermometer:
                    samples["temperature_c"][rows] = np.nan
        return samples

    def table(self) -> str:
        """Return the table of packs in the format that ``fleet packs load`` reads."""
        lines = [",".join(COLUMNS)]
        lines += [
            table_row(name, KINDS[index]) for name, index in zip(self.names, self._kind_index.tolist(), strict=True)
        ]
        return "\n".join(lines) + "\n"

    def soc(self, packs: Ints, time_s: Floats) -> Floats:
        """Return the true SOC 0..1 of each pack at its edge's ``time_s``, in the same shape."""
        minute = np.floor(time_s / BLOCK_S)
        pulse_a = self._pulse_a(packs, minute.astype(np.int64))
        pulse_as = pulse_a * _pulse_charge_s(time_s - minute * BLOCK_S)
        return self._slow_soc(packs, time_s) - pulse_as / self.true_capacity_as[packs]

    def _slow_soc(self, packs: Ints, time_s: Floats) -> Floats:
        angle = self._omega[packs] * time_s + self._phase[packs]
        return MEAN_SOC + SOC_AMPLITUDE * (
            SLOW_FRACTION * np.sin(angle) + FAST_FRACTION * np.sin(FREQUENCY_RATIO * angle)
        )

    def _slow_a(self, packs: Ints, time_s: Floats) -> Floats:
        """Return the current [A] that produces ``_slow_soc``, positive on discharge."""
        angle, omega = self._omega[packs] * time_s + self._phase[packs], self._omega[packs]
        slope = (
            SOC_AMPLITUDE
            * omega
            * (SLOW_FRACTION * np.cos(angle) + FREQUENCY_RATIO * FAST_FRACTION * np.cos(FREQUENCY_RATIO * angle))
        )
        return -slope * self.true_capacity_as[packs]

    def _pulse_a(self, packs: Ints, minutes: Ints) -> Floats:
        """Return the current of the pulse in each minute [A]."""
        return (
            PULSE_C / 3600.0 * self.true_capacity_as[packs] * (2.0 * self._uniform(packs, _Draw.PULSE, minutes) - 1.0)
        )

    def _current_and_voltage(self, packs: Ints, numbers: Ints, curves: _Curves) -> tuple[Floats, Floats]:
        """Return true current [A] and terminal voltage [V] in each second of a block, both of shape (n, BLOCK_S)."""
        column, second = packs[:, None], np.arange(BLOCK_S, dtype=np.float64)
        time_s = (numbers[:, None] - 1) * BLOCK_S + second
        # to first order, the slow branch delays the slow current by its time constant
        slow_a, delayed_a = self._slow_a(column, time_s), self._slow_a(column, time_s - TAU_TL_S)
        # pulses of this minute (first column) and of the minutes before
        pulse_a = self._pulse_a(column, numbers[:, None] - 1 - np.arange(PAST_PULSES + 1))
        current_a = slow_a + pulse_a[:, :1] * _PULSE
        branch_a = (
            slow_a + pulse_a[:, :1] * _RESPONSE + (pulse_a[:, 1:] @ _REMAINDER)[:, None] * np.exp(-second / TAU_TS_S)
        )
        soc = self.soc(column, time_s)
        ocv_v, r_s, r_ts, r_tl = (
            np.interp(soc, curves.soc, values) for values in (curves.ocv_v, curves.r_s, curves.r_ts, curves.r_tl)
        )
        drop_v = r_s * current_a + r_ts * branch_a + r_tl * delayed_a  # (2.4) of the thesis
        return current_a, ocv_v - self.true_resistance[column] * drop_v

    def _uniform(self, packs: Ints, draw: _Draw, index: Ints | int = 0) -> Floats:
        """Return uniform numbers in [0, 1) that depend only on seed, pack, ``draw`` and ``index``."""
        key = _mix(np.asarray(packs, dtype=np.uint64) + (self._salt << np.uint64(32)) + np.uint64(draw << 56))
        bits = _mix(key + np.asarray(index).astype(np.uint64)) >> np.uint64(11)
        return bits.astype(np.float64) * 2.0**-53  # a double has 53 bits


def _mix(bits: Bits) -> Bits:
    """Return pseudo-random bits: the finalizer of SplitMix64 (Steele et al., OOPSLA 2014)."""
    with np.errstate(over="ignore"):
        bits = bits * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return bits ^ (bits >> np.uint64(31))


def table_row(name: str, kind: Kind) -> str:
    """Return a pack's row of the table of packs, without the end of the line."""
    cells = (kind.cell, "" if kind.capacity_ah is None else kind.capacity_ah, kind.series, kind.parallel)
    return ",".join(map(str, (name, *cells, kind.voltage_resolution_v, kind.current_resolution_a, 1)))


def _quantize(values: Floats, noise: Floats, step: float) -> Floats:
    """Quantize ``values`` with ``noise`` [steps] to the steps of an A/D converter."""
    quantized: Floats = np.rint(values / step + noise) * step
    return quantized


def _pulse_charge_s(second: Floats) -> Floats:
    """Return the charge of a pulse of 1 A up to ``second`` of its minute [A s]."""
    return np.where(second < PULSE_S, second, PULSE_S * (BLOCK_S - second) / (BLOCK_S - PULSE_S))


def _response() -> tuple[Floats, Floats, Floats]:
    """Return the response to a pulse of 1 A [A].

    Returns:
        The current in each second of the minute; the current of the branch ``TAU_TS_S`` in each second; its remainder at the
        beginning of each following minute.
    """
    second = np.arange(BLOCK_S)
    pulse = np.where(second < PULSE_S, 1.0, -PULSE_S / (BLOCK_S - PULSE_S))
    decay = math.exp(-1.0 / TAU_TS_S)
    branch_current = np.zeros(BLOCK_S + 1)
    for i in second:
        branch_current[i + 1] = branch_current[i] * decay + pulse[i] * (1.0 - decay)
    return pulse, branch_current[:-1], branch_current[-1] * np.exp(-np.arange(PAST_PULSES) * BLOCK_S / TAU_TS_S)


_PULSE, _RESPONSE, _REMAINDER = _response()
