"""Packs that never were: what a fleet's edges would send, and the truth beside it.

Nothing is stored: a block is a function of seed, pack and number, so that 100,000 packs need no disk and any block
can be sent again. SOC is a closed form of time, so that whoever estimates can be judged at any moment.

A pack swings slowly between full and empty, with a pulse each minute that takes no charge over it. Its voltage is that of
the shipped cell's OCV and elements (2.4), with two branches of fixed time constants; capacity and resistances differ
from what the table of packs declares, as ages and makes do.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bms_estimator.edge.block import Block, encode
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.kernels.cell_model.chen_mora import OCV_POINTS
from bms_estimator.model.arrays import Floats
from bms_estimator.model.cell import CellModel, load_cell
from bms_estimator.model.sample import SAMPLE, SampleBlock

Whole = NDArray[np.int64]
Bits = NDArray[np.uint64]

BLOCK_S = 60
"""Length of a block at one sample a second [s]."""
MIDDLE_SOC, SWING_SOC = 0.52, 0.36
"""SOC range is 0.16 to 0.88."""
SLOW, QUICK, QUICKNESS = 0.75, 0.25, 3.3
"""Shares of the two oscillations of SOC, and how much faster the second is."""
MIN_S, MAX_S = 8 * 3600.0, 24 * 3600.0
"""Period of the slow one [s]: up to 0.43 C."""
PULSE_S, PULSE_C = 15, 0.6
"""Length [s] and maximum size [C] of a pulse in each minute; a third of it in the other direction follows."""
PAST_MINUTES = 5
"""Number of pulses that still have an effect: e^(-300/20) of a pulse remains after that."""
TAU_TS_S, TAU_TL_S = 20.0, 800.0
"""Time constants of the branches [s]."""
JITTER_S = 0.02
"""Maximum error of a real device's timestamps [s]."""
WORN, NEW, TIRED = 0.75, 1.02, 0.6
"""Range of true to declared capacity, and its value for a pack with a defect."""
MAX_RESISTANCE, FAILING = 1.6, 3.0
"""True resistances to the cell file's: the range begins at 0.8; and those of a pack about to fail."""
OUTLIERS = 0.01
"""Part of the packs that is tired, and as many again that are failing."""


class Kind(NamedTuple):
    """Values that many packs share."""

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
"""A store at home, a bicycle, a scooter, a pack of the shipped cell: a quarter of the fleet each."""

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
    """A kind's cells as functions of SOC on one grid: OCV [V] and elements [ohm] of the whole pack."""

    def __init__(self, kind: Kind) -> None:
        pack: CellModel = load_cell(kind.cell, kind.capacity_ah).pack(kind.series, kind.parallel)
        a, soc = pack.a, np.linspace(0.0, 1.0, OCV_POINTS)
        self.capacity_as = pack.cell.capacity_ah * 3600.0
        self.soc, self.ocv_v = soc, ocv_grid(pack)[0]
        self.r_s, self.r_ts, self.r_tl = (a[i] * np.exp(-a[i + 1] * soc) + a[i + 2] for i in (13, 1, 4))


@dataclass(frozen=True)
class Truth:
    """Ground truth of each pack, which no estimator gets. Arrays of shape (packs,)."""

    capacity_as: Floats
    """[A s]"""
    resistance: Floats
    """Times the cell file's elements."""


class SimulatedFleet:
    """A fleet of ``packs`` packs.

    Args:
        packs: Number of packs.
        seed: Another seed, another fleet.
        begin_ns: When the first edge's store was made [ns since 1970]; the others' follow within a minute.
        prefix: Prefix of the packs' names.

    Attributes:
        names: Names of the packs.
        store: When each edge's store was made [ns since 1970], shape (packs,).
        truth: The true values.
    """

    def __init__(self, packs: int, *, seed: int, begin_ns: int, prefix: str = "sim") -> None:
        pack = np.arange(packs, dtype=np.int64)
        self.names = tuple(f"{prefix}-{i:06d}" for i in range(packs))
        self._salt = np.uint64(seed % 2**64)
        self._curves = tuple(_Curves(kind) for kind in KINDS)
        self._kind = pack % len(KINDS)
        within_s = self._dice(pack, 1) * BLOCK_S
        self.begin_ns = begin_ns
        self.store: Whole = begin_ns + (within_s * 1e9).astype(np.int64)
        self._omega = 2.0 * math.pi / (MIN_S + (MAX_S - MIN_S) * self._dice(pack, 2))
        self._phase = 2.0 * math.pi * self._dice(pack, 3)
        self._warm_c = np.round(20.0 + 10.0 * self._dice(pack, 4), 1)
        self.truth = self._aged(pack)

    def _aged(self, pack: Whole) -> Truth:
        fate = self._dice(pack, 5)
        capacity = WORN + (NEW - WORN) * self._dice(pack, 6)
        resistance = 0.8 + (MAX_RESISTANCE - 0.8) * self._dice(pack, 7)
        capacity[fate < OUTLIERS] = TIRED
        resistance[(fate >= OUTLIERS) & (fate < 2 * OUTLIERS)] = FAILING
        rated_as = np.array([curves.capacity_as for curves in self._curves])
        return Truth(capacity * rated_as[self._kind], resistance)

    def kind(self, pack: int) -> Kind:
        """Return the declared kind of a pack."""
        return KINDS[self._kind[pack]]

    def blocks(self, packs: Whole, numbers: Whole, arrival_s: Floats) -> Iterator[bytes]:
        """Return one block for each pack, as edges send it.

        Args:
            packs: Numbers of the packs, shape (n,).
            numbers: Numbers of the blocks, from 1.
            arrival_s: Wall clock at the arrival of each block's last sample [s since 1970].
        """
        samples = self.samples(packs, numbers)
        for i, (pack, number) in enumerate(zip(packs.tolist(), numbers.tolist(), strict=True)):
            yield encode(Block(int(self.store[pack]), number, 1, float(arrival_s[i]), samples[i]))

    def samples(self, packs: Whole, numbers: Whole) -> SampleBlock:
        """One block of each of ``packs``: shape (n, BLOCK_S), dtype ``SAMPLE``."""
        second = np.arange(BLOCK_S)
        index = ((numbers[:, None] - 1) * BLOCK_S + second).astype(np.int64)
        samples = np.zeros((packs.size, BLOCK_S), dtype=SAMPLE)
        samples["time_s"] = index + np.round(JITTER_S * self._dice(packs[:, None], 8, index), 3)
        samples["temperature_c"] = self._warm_c[packs][:, None]
        for kind, (declared, curves) in enumerate(zip(KINDS, self._curves, strict=True)):
            rows = np.flatnonzero(self._kind[packs] == kind)
            if rows.size:
                current_a, voltage_v = self._terminals(packs[rows], numbers[rows], curves)
                noise = [self._dice(packs[rows][:, None], what, index[rows]) - 0.5 for what in (9, 10)]
                samples["current_a"][rows] = _read(current_a, noise[0], declared.current_resolution_a)
                samples["voltage_v"][rows] = _read(voltage_v, 2.0 * noise[1], declared.voltage_resolution_v)
                if not declared.thermometer:
                    samples["temperature_c"][rows] = np.nan
        return samples

    def table(self) -> str:
        """Return the table of packs in the format that ``fleet packs load`` reads."""
        lines = [",".join(COLUMNS)]
        lines += [_row(name, KINDS[kind]) for name, kind in zip(self.names, self._kind.tolist(), strict=True)]
        return "\n".join(lines) + "\n"

    def truth_table(self) -> str:
        """Return the ground truth as CSV, which no estimator gets."""
        rows = zip(self.names, self.truth.capacity_as.tolist(), self.truth.resistance.tolist(), strict=True)
        lines = ["pack,capacity_ah,resistance_factor"]
        lines += [f"{name},{capacity_as / 3600.0:.4f},{factor:.4f}" for name, capacity_as, factor in rows]
        return "\n".join(lines) + "\n"

    def soc(self, packs: Whole, time_s: Floats) -> Floats:
        """Return the true SOC 0..1 of each pack at its edge's ``time_s``, in the same shape."""
        minute = np.floor(time_s / BLOCK_S)
        pulse_a = self._pulse_a(packs, minute.astype(np.int64))
        pulse_as = pulse_a * _pulse_charge_s(time_s - minute * BLOCK_S)
        return self._slow_soc(packs, time_s) - pulse_as / self.truth.capacity_as[packs]

    def _slow_soc(self, packs: Whole, time_s: Floats) -> Floats:
        angle = self._omega[packs] * time_s + self._phase[packs]
        return MIDDLE_SOC + SWING_SOC * (SLOW * np.sin(angle) + QUICK * np.sin(QUICKNESS * angle))

    def _slow_a(self, packs: Whole, time_s: Floats) -> Floats:
        """Return the current [A] that produces ``_slow_soc``, positive on discharge."""
        angle, omega = self._omega[packs] * time_s + self._phase[packs], self._omega[packs]
        slope = SWING_SOC * omega * (SLOW * np.cos(angle) + QUICKNESS * QUICK * np.cos(QUICKNESS * angle))
        return -slope * self.truth.capacity_as[packs]

    def _pulse_a(self, packs: Whole, minutes: Whole) -> Floats:
        """Height [A] of the pulse in each minute."""
        return PULSE_C / 3600.0 * self.truth.capacity_as[packs] * (2.0 * self._dice(packs, 11, minutes) - 1.0)

    def _terminals(self, packs: Whole, numbers: Whole, curves: _Curves) -> tuple[Floats, Floats]:
        """Return true current [A] and voltage [V] in each second of a block, both of shape (n, BLOCK_S)."""
        column, second = packs[:, None], np.arange(BLOCK_S, dtype=np.float64)
        time_s = (numbers[:, None] - 1) * BLOCK_S + second
        slow_a, late_a = self._slow_a(column, time_s), self._slow_a(column, time_s - TAU_TL_S)
        past_a = self._pulse_a(column, numbers[:, None] - 1 - np.arange(PAST_MINUTES + 1))
        current_a = slow_a + past_a[:, :1] * _PULSE
        felt_a = slow_a + past_a[:, :1] * _RESPONSE + (past_a[:, 1:] @ _REST)[:, None] * np.exp(-second / TAU_TS_S)
        soc = self.soc(column, time_s)
        ocv_v, r_s, r_ts, r_tl = (
            np.interp(soc, curves.soc, values) for values in (curves.ocv_v, curves.r_s, curves.r_ts, curves.r_tl)
        )
        drop_v = r_s * current_a + r_ts * felt_a + r_tl * late_a  # (2.4)
        return current_a, ocv_v - self.truth.resistance[column] * drop_v

    def _dice(self, packs: Whole, what: int, index: Whole | int = 0) -> Floats:
        """Numbers in [0, 1) that follow from seed, pack, ``what`` and ``index`` alone."""
        key = _mixed(np.asarray(packs, dtype=np.uint64) + (self._salt << np.uint64(32)) + np.uint64(what << 56))
        bits = _mixed(key + np.asarray(index).astype(np.uint64)) >> np.uint64(11)
        return bits.astype(np.float64) * 2.0**-53


def _mixed(bits: Bits) -> Bits:
    """Bits that look random: the finalizer of SplitMix64 (Steele et al., OOPSLA 2014)."""
    with np.errstate(over="ignore"):
        bits = bits * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return bits ^ (bits >> np.uint64(31))


def _row(name: str, kind: Kind) -> str:
    cells = (kind.cell, "" if kind.capacity_ah is None else kind.capacity_ah, kind.series, kind.parallel)
    return ",".join(map(str, (name, *cells, kind.voltage_resolution_v, kind.current_resolution_a, 1)))


def _read(values: Floats, noise: Floats, step: float) -> Floats:
    """Quantize ``values`` with ``noise`` to the steps of a converter."""
    read: Floats = np.rint(values / step + noise) * step
    return read


def _pulse_charge_s(second: Floats) -> Floats:
    """Charge that a pulse of 1 A has taken ``second`` into its minute [A s]."""
    return np.where(second < PULSE_S, second, PULSE_S * (BLOCK_S - second) / (BLOCK_S - PULSE_S))


def _response() -> tuple[Floats, Floats, Floats]:
    """Return the response to a pulse of 1 A [A].

    Returns:
        The current in each second of its minute; what a branch of ``TAU_TS_S`` feels of it then; its effect at the
        beginning of each of the following minutes.
    """
    second = np.arange(BLOCK_S)
    pulse = np.where(second < PULSE_S, 1.0, -PULSE_S / (BLOCK_S - PULSE_S))
    decay = math.exp(-1.0 / TAU_TS_S)
    felt = np.zeros(BLOCK_S + 1)
    for i in second:
        felt[i + 1] = felt[i] * decay + pulse[i] * (1.0 - decay)
    return pulse, felt[:-1], felt[-1] * np.exp(-np.arange(PAST_MINUTES) * BLOCK_S / TAU_TS_S)


_PULSE, _RESPONSE, _REST = _response()
