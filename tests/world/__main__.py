"""Program of ``make simulate``, which runs worlds determined by seeds.

python -m tests.world --seed 5              Run one world and print its last log lines.
python -m tests.world --seeds 1000          Run 1000 worlds on all processors.
python -m tests.world --seed 5 --hours 24   Run one world for 24 h.
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
    """Run one world, then free its objects."""
    result = World(seed, seconds).run()
    gc.collect()
    return result


def main() -> int:
    """Run the requested worlds; return 1 if an invariant was violated."""
    parser = argparse.ArgumentParser(prog="make simulate", description="The whole service, simulated from one seed.")
    parser.add_argument("--seed", type=int, default=None, help="seed of a single world")
    parser.add_argument("--seeds", type=int, default=20, help="number of worlds")
    parser.add_argument("--first", type=int, default=0, help="first seed of several worlds")
    parser.add_argument("--hours", type=float, default=1.0, help="duration of a world [h]")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="number of worlds at the same time")
    options = parser.parse_args()
    load_kernels()
    gc.disable()  # ``run`` collects after each world, so that no collection slows a world down
    gc.freeze()  # shared objects are not scanned after each world
    if options.seed is not None:
        return _print_result(run(options.seed, options.hours * HOUR_S), log=True)
    return _run_many(options)


def _print_result(result: Result, *, log: bool = False) -> int:
    """Print the result of a world, with its last log lines if ``log`` is set. Return 1 if an invariant was violated."""
    if log:
        _print_line("\n".join(result.log))
    errors = result.soc_errors
    coverage_percent = 100.0 * errors.within_interval / max(errors.states, 1)
    figures = ", ".join(f"{name} {value:g}" for name, value in result.figures.items())
    _print_line(
        f"seed {result.seed}: {result.violation or 'all invariants hold'}; SOC off by {100.0 * errors.max_error:.1f} % and "
        f"{errors.max_stds:.1f} std at most, {coverage_percent:.0f} % within 2 std; {figures}; digest {result.digest}"
    )
    return int(bool(result.violation))


def _print_line(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _run_many(options: argparse.Namespace) -> int:
    begin_s, failed, errors = time.monotonic(), [], []
    seeds = range(options.first, options.first + options.seeds)
    context = multiprocessing.get_context("fork")  # inherits the compiled kernels
    with ProcessPoolExecutor(options.processes, context) as pool:
        for result in pool.map(partial(run, seconds=options.hours * HOUR_S), seeds):
            errors.append(result.soc_errors)
            if result.violation:
                failed.append(result.seed)
                _print_line(f"make simulate SEED={result.seed}: {result.violation}")
    seconds, cpu = time.monotonic() - begin_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    states = sum(each.states for each in errors)
    coverage = sum(each.within_interval for each in errors) / max(states, 1)
    _print_line(
        f"{len(seeds)} worlds of {options.hours:g} h in {seconds:.0f} s, on {options.processes} processors, "
        f"{(cpu.ru_utime + cpu.ru_stime) / len(seeds):.2f} s of CPU time each; SOC off by "
        f"{100.0 * max(each.max_error for each in errors):.1f} % and {max(each.max_stds for each in errors):.1f} std at "
        f"most, {100.0 * coverage:.1f} % of {states} states within 2 std; "
        f"{len(failed)} failed"
    )
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
