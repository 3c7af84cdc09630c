"""``make simulate``: worlds from seeds.

python -m tests.world --seed 5              one world; its log where something does not hold
python -m tests.world --seeds 1000          many, on all processors
python -m tests.world --seed 5 --hours 24   longer
"""

import argparse
import gc
import multiprocessing
import os
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from bms_estimator.service.kernel_warm_up import load_kernels
from tests.world.world import Result, World

HOUR_S = 3600.0


def run(seed: int, seconds: float) -> Result:
    """Run one world."""
    result = World(seed, seconds).run()
    gc.collect()
    return result


def main() -> int:
    """Run the requested worlds; return 1 if an invariant was violated."""
    parser = argparse.ArgumentParser(prog="make simulate", description="The whole service, simulated from one seed.")
    parser.add_argument("--seed", type=int, default=None, help="one world")
    parser.add_argument("--seeds", type=int, default=20, help="so many worlds")
    parser.add_argument("--first", type=int, default=0, help="the first seed of many")
    parser.add_argument("--hours", type=float, default=1.0, help="how long a world lasts")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="worlds at the same time")
    options = parser.parse_args()
    load_kernels()
    gc.disable()  # no collection during a world
    gc.freeze()  # shared objects are not scanned after each world
    if options.seed is not None:
        return _show(run(options.seed, options.hours * HOUR_S), log=True)
    return _many(options)


def _show(result: Result, *, log: bool = False) -> int:
    """Print the result of a world, with its last log lines if it failed."""
    if log:
        _say("\n".join(result.log))
    band = result.band
    share = 100.0 * band.inside / max(band.states, 1)
    figures = ", ".join(f"{name} {value:g}" for name, value in result.figures.items())
    _say(
        f"seed {result.seed}: {result.wrong or 'all holds'}; SOC off by {100.0 * band.worst_error:.1f} % and "
        f"{band.worst_stds:.1f} std at most, {share:.0f} % within 2 std; {figures}; digest {result.digest}"
    )
    return int(bool(result.wrong))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _many(options: argparse.Namespace) -> int:
    begun_s, failed, bands = time.monotonic(), [], []
    seeds = range(options.first, options.first + options.seeds)
    context = multiprocessing.get_context("fork")  # inherits the compiled kernels
    with ProcessPoolExecutor(options.processes, context) as pool:
        for result in pool.map(partial(run, seconds=options.hours * HOUR_S), seeds):
            bands.append(result.band)
            if result.wrong:
                failed.append(result.seed)
                _say(f"make simulate SEED={result.seed}: {result.wrong}")
    seconds, cpu = time.monotonic() - begun_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    inside = sum(band.inside for band in bands) / max(sum(band.states for band in bands), 1)
    _say(
        f"{len(seeds)} worlds of {options.hours:g} h in {seconds:.0f} s, on {options.processes} processors, "
        f"{(cpu.ru_utime + cpu.ru_stime) / len(seeds):.2f} s of processor each; SOC off by "
        f"{100.0 * max(band.worst_error for band in bands):.1f} % and {max(band.worst_stds for band in bands):.1f} std at "
        f"most, {100.0 * inside:.1f} % of {sum(band.states for band in bands)} states within 2 std; "
        f"{len(failed)} failed"
    )
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
