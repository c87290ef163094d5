"""Measure how much the times of a comparison differ between repeated runs.

    python benchmarks/repeated_times.py FOLDER [--recipe plane-methods] [--step plane] [--runs 2]

Runs `orthoflow run RECIPE` into `FOLDER/1` with a new store and no compiled code, then into
`FOLDER/2`, `FOLDER/3` ... with the step forced; existing runs are reused. Each run is compared with
the previous one by every metric `*_s` of the step's cells except `compile_s`, provided that one of
the two values exceeds 0.2 s. The output lists times that differ by more than 30 %. For each time,
it lists the variants in the order of the medians of their repeats, and the pairs that change order;
smaller differences are not significant, neither here nor in a report. On a machine with other load,
only `cpu_s` and `*_cpu_s` are meaningful; the load is also printed.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping
from itertools import combinations, pairwise
from pathlib import Path

from orthoflow.records.open import open_run

LEAST_S = 0.2
FURTHEST = 1.3

Times = Mapping[tuple[str, str], float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recipe", default="plane-methods")
    parser.add_argument("--step", default="plane")
    parser.add_argument("--runs", type=int, default=2)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    runs = [
        measured(options.folder, f"{options.recipe}.yaml", options.step, number)
        for number in range(1, options.runs + 1)
    ]
    for number, (before, after) in enumerate(pairwise(runs), start=1):
        print(f"\nruns {number} and {number + 1}")
        print_pairs(before, after)
        print_orders(before, after)


def measured(folder: Path, recipe: str, step: str, number: int) -> Times:
    """Run a recipe, or open its existing run; return its times by cell and name."""
    target = folder / str(number)
    if not (target / "run.h5").is_file():
        command = [sys.executable, "-m", "orthoflow", "run", recipe, "-o", str(target)]
        command += ["--store", str(folder / "store"), *(["--force", step] if number > 1 else [])]
        # Kernels compiled in earlier runs are not used.
        variables = {**os.environ, "NUMBA_CACHE_DIR": str(folder.resolve() / "kernels")}
        before = os.getloadavg()[0]
        subprocess.run(command, check=True, env=variables, stdout=subprocess.DEVNULL)
        loads = {"before": before, "at its end, of 15 minutes": os.getloadavg()[2]}
        (folder / f"load_{number}.json").write_text(json.dumps(loads))
    if (loads_file := folder / f"load_{number}.json").is_file():
        print(f"run {number}: load {json.loads(loads_file.read_text())}")
    return {
        (row.cell, row.metric): row.value
        for row in open_run(target).metric_rows()
        if row.step == step and row.metric.endswith("_s") and row.metric != "compile_s"
    }


def print_pairs(before: Times, after: Times) -> None:
    """Print times that changed by more than the limit, and their number per name."""
    compared: defaultdict[str, list[bool]] = defaultdict(list)
    for (cell, name), first in before.items():
        second = after.get((cell, name), first)
        if max(first, second) <= LEAST_S:
            continue
        is_beyond = max(first, second) > FURTHEST * min(first, second)
        compared[name].append(is_beyond)
        if is_beyond:
            print(f"{cell:32s} {name:14s} {first:8.2f} {second:8.2f} s  x {second / first:.2f}")
    for name, beyond in compared.items():
        print(f"{name}: {sum(beyond)} of {len(beyond)} moved by more than {FURTHEST - 1:.0%}")


def print_orders(before: Times, after: Times) -> None:
    """Print the variants from fastest to slowest, and those that changed order, with ratios."""
    for name in dict.fromkeys(name for _, name in before):
        first, second = medians(before, name), medians(after, name)
        print(f"{name}: {' < '.join(sorted(first, key=lambda one: first[one]))}")
        swaps = {
            pair: max(apart(first, pair), apart(second, pair))
            for pair in combinations(sorted(first.keys() & second.keys()), 2)
            if (first[pair[0]] < first[pair[1]]) != (second[pair[0]] < second[pair[1]])
        }
        apart_of = [max(apart(first, pair), apart(second, pair)) for pair in combinations(first, 2)]
        n_apart = sum(ratio > FURTHEST for ratio in apart_of)
        moved = sorted((pair for pair in swaps if swaps[pair] > FURTHEST), key=swaps.__getitem__)
        print(
            f"  {len(moved)} of {n_apart} pairs that are further apart change places, and "
            f"{len(swaps) - len(moved)} of {len(apart_of) - n_apart} nearer ones"
        )
        for pair in moved:
            print(f"  x {swaps[pair]:.2f}: {' and '.join(pair)}")


def medians(times: Times, name: str) -> dict[str, float]:
    """Return the median over the repeats of each variant."""
    of: defaultdict[str, list[float]] = defaultdict(list)
    for (cell, metric), value in times.items():
        if metric == name:
            of[cell.partition("#")[0].partition("=")[2]].append(value)
    return {variant: statistics.median(values) for variant, values in of.items()}


def apart(values: Mapping[str, float], pair: tuple[str, str]) -> float:
    """Return the larger of two numbers divided by the smaller."""
    return max(values[one] for one in pair) / min(values[one] for one in pair)


if __name__ == "__main__":
    main()
