"""Ablation of the forecast: its scores without one part at a time, from one replay of each capture."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bms_estimator.estimator import Estimator
from bms_estimator.forecast.forecaster import Forecaster
from bms_estimator.forecast.load_spread import LoadSpread, load_spread
from bms_estimator.forecast.projection import discharges, project_observed_load, time_quantiles
from bms_estimator.kernels.cell_model.rc_ladder import GRID
from bms_estimator.kernels.forecast.projected_pack import FAST_RESISTANCES, growth_factor
from bms_estimator.model.arrays import Floats, Records
from bms_estimator.model.cell import CellModel
from tests.benchmarks.forecast.baselines import UNKNOWN, Quantiles
from tests.benchmarks.forecast.captures import Case
from tests.benchmarks.forecast.measure import MAX_LEFT_S, outcome
from tests.benchmarks.forecast.moments import moments_of
from tests.benchmarks.forecast.scores import Outcome
from tests.benchmarks.forecast.truth import Discharge

SHUFFLED_S = 10
"""Length of the pieces of the load whose order is lost [s]."""
SHUFFLE_SEED = 1
NORMAL_DEGREES = 1e6
"""Degrees of freedom with which Student's t distribution is practically normal."""

ObservedLoad = tuple[Floats, Floats]
"""Mean and largest current of each second [A]."""


def unchanged(observed: ObservedLoad) -> ObservedLoad:
    """Return the load as it is."""
    return observed


def last_seconds(seconds: int) -> Callable[[ObservedLoad], ObservedLoad]:
    """Return a function that returns the last ``seconds`` of a load."""
    return lambda observed: (observed[0][-seconds:], observed[1][-seconds:])


def without_peaks(observed: ObservedLoad) -> ObservedLoad:
    """Return a load whose largest current of each second is its mean."""
    return observed[0], observed[0]


def shuffled(observed: ObservedLoad) -> ObservedLoad:
    """Return a load whose pieces of ``SHUFFLED_S`` are in random order."""
    pieces = observed[0].size // SHUFFLED_S
    order = np.random.default_rng(SHUFFLE_SEED).permutation(pieces)
    mean_a, max_a = (part[: pieces * SHUFFLED_S].reshape(pieces, SHUFFLED_S)[order].ravel() for part in observed)
    return mean_a, max_a


def own_spread(spread: LoadSpread) -> LoadSpread:
    """Return the spread as it is."""
    return spread


def no_spread(spread: LoadSpread) -> LoadSpread:
    """Return the spread of a load whose future mean is known."""
    return replace(spread, std=0.0)


def fixed_spread(_: LoadSpread) -> LoadSpread:
    """Return a spread of 10 % that does not depend on the load."""
    return LoadSpread(0.1, NORMAL_DEGREES)


@dataclass(frozen=True)
class Part:
    """Part of the forecast, and what disables it."""

    name: str
    pack: Mapping[str, float] = field(default_factory=dict)
    """Fields of PROJECTED_PACK with the values that disable the part."""
    grows: bool = True
    """False: the fast resistances do not grow towards empty."""
    load: Callable[[ObservedLoad], ObservedLoad] = unchanged
    """Function that changes the observed load."""
    spread: Callable[[LoadSpread], LoadSpread] = own_spread
    """Function that changes the spread of the mean load."""


STDS = ("soc_std", "capacity_std", "voltage_std_v", "resistance_std")
"""Fields of PROJECTED_PACK with the spread of the draws."""
GROWTH = Part("growth of R towards empty", grows=False)
GRADIENT = Part("SOC gradient in the particles", {"surface_soc": 0.0})
PARTS = (
    Part("nothing"),
    Part("load before the last 7,200 s", load=last_seconds(7200)),
    Part("load before the last 1,800 s", load=last_seconds(1800)),
    Part("order of the load beyond 10 s", load=shuffled),
    Part("peaks within a second", load=without_peaks),
    GROWTH,
    GRADIENT,
    Part("spread: mean load", spread=no_spread),
    Part("spread: mean load, but always 10 %", spread=fixed_spread),
    *(Part(f"spread: {name}", {name: 0.0}) for name in STDS),
    Part("all spreads but the load's order", dict.fromkeys(STDS, 0.0), spread=no_spread),
)
"""Parts of the forecast."""


def disable(part: Part, pack: Records, estimator: Estimator) -> None:
    """Disable a part in ``pack``, shape (1,), dtype ``PROJECTED_PACK``, which was computed from the state of ``estimator``."""
    for name, value in part.pack.items():
        pack[name] = value
    if not part.grows:
        state, nodes = estimator.record[0]["filter"], np.linspace(0.0, 1.0, GRID)
        pack["ohm"][0, :FAST_RESISTANCES] /= [growth_factor(state, pack["soc"][0], soc) for soc in nodes]


def quantiles_without(part: Part, forecaster: Forecaster) -> Quantiles:
    """Return the quantiles of a forecast from the present state without a part; unknown if the load discharges no pack."""
    pack = forecaster.projected_pack()
    disable(part, pack, forecaster.estimator)
    mean_a, max_a = part.load(forecaster.load.mean_and_max())
    current_a = mean_a - pack["offset_a"][0]
    if not discharges(pack, float(current_a.mean())):
        return UNKNOWN
    spread = part.spread(load_spread(current_a))
    return Quantiles(*time_quantiles(project_observed_load(pack, mean_a, max_a, spread, forecaster.seed).time_s))


def outcomes_without_parts(case: Case, discharge: Discharge, cell: CellModel, interval_s: float) -> Iterator[Outcome]:
    """Yield the outcomes of the forecast without each part, with the name of the part as method."""
    estimator = Estimator(cell)
    forecaster = Forecaster(estimator, estimator, cutoff_v=discharge.cutoff_v)
    for moment in moments_of(forecaster, discharge, interval_s):
        if moment.forecast.reason or min(moment.left_s, moment.value("time_to_cutoff_s")) >= MAX_LEFT_S:
            continue
        for part in PARTS:
            yield outcome(part.name, quantiles_without(part, forecaster), case, discharge, cell, moment)
