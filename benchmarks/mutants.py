"""Draw mutants of the source by seed and report which of them the tests do not notice.

    python benchmarks/mutants.py --seed 1 --n 40 [--package orthoflow/geometry] [--no-golden]

Cosmic Ray makes and applies the mutants (extra `dev`); here they are drawn, and each is tested by
the tests of its own folder, on a copy of the checkout. Exit code 0 when nine of ten were killed,
2 when tests fail without any.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
SOURCES: Final = ("orthoflow", "plugins/orthoflow_plugins", "provenance/orthoflow_provenance")
KILLED_SHARE: Final = 0.9
# `|` mostly joins types, and what is raised or decorated is no arithmetic.
LEFT_OUT: Final = ("BitOr", "Decorator", "ExceptionReplacer", "ZeroIteration", "VariableInserter")


def main() -> int:
    """Draw, apply and test the mutants, and print one line for each."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--seed", type=int, required=True)
    asked.add_argument("--n", type=int, default=40, help="how many mutants")
    asked.add_argument("--package", default="", help="only modules below this folder")
    asked.add_argument("--timeout", type=float, default=600.0, help="seconds for each mutant")
    asked.add_argument("--no-golden", action="store_true", help="without recorded results")
    args = asked.parse_args()

    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_item import TestOutcome

    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder, "orthoflow")
        left_out = shutil.ignore_patterns(".git", ".orthoflow", "__pycache__", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=left_out)
        os.chdir(copy)
        paths = os.pathsep.join(str(copy / one) for one in (".", "plugins", "provenance"))
        # Kernels are found by the content of all that they call, so mutants share a folder.
        kernels = str(Path(folder, "kernels"))
        os.environ.update(PYTHONPATH=paths, PYTHONDONTWRITEBYTECODE="1", NUMBA_CACHE_DIR=kernels)
        alive = 0
        sound: dict[str, bool] = {}
        mutants = drawn(args.seed, args.n, args.package)
        for number, mutation in enumerate(mutants, 1):
            command = shlex.join(test_command(mutation.module_path, golden=not args.no_golden))
            if command not in sound:
                untouched = mutate_and_test([], command, args.timeout)
                sound[command] = untouched.test_outcome is TestOutcome.SURVIVED
            if not sound[command]:
                print(f"these tests fail on the source as it is: {command}")
                return 2
            result = mutate_and_test([mutation], command, args.timeout)
            lives = result.test_outcome is TestOutcome.SURVIVED
            alive += lives
            place = f"{mutation.module_path}:{mutation.start_pos[0]}"
            print(f"{number:3} {'LIVES ' if lives else 'killed'} {place} {mutation.operator_name}")
            if lives:
                print("\n".join(one for one in result.diff.splitlines() if one[:1] in "+-"))
    print(f"{len(mutants) - alive} of {len(mutants)} killed")
    return 0 if alive <= (1.0 - KILLED_SHARE) * len(mutants) else 1


def drawn(seed: int, n: int, package: str = "") -> list:  # type: ignore[type-arg]
    """Return `n` mutations, each of a module that is drawn by its number of places."""
    from cosmic_ray.commands.init import _all_work_items

    chosen = random.Random(seed)
    modules = [
        path.relative_to(ROOT)
        for source in SOURCES
        for path in sorted((ROOT / source).rglob("*.py"))
        if str(path.relative_to(ROOT)).startswith(package)
    ]
    weights = [path.stat().st_size for path in (ROOT / one for one in modules)]
    mutants: list = []  # type: ignore[type-arg]
    while len(mutants) < n:
        (module,) = chosen.choices(modules, weights)
        annotated = set(annotation_lines(ROOT / module))
        places = [
            item.mutations[0]
            for item in _all_work_items([module], {})
            if not any(word in item.mutations[0].operator_name for word in LEFT_OUT)
            and item.mutations[0].start_pos[0] not in annotated
        ]
        if places:
            mutants.append(chosen.choice(places))
    return mutants


def annotation_lines(path: Path) -> Iterator[int]:
    """Yield the lines of a module that hold annotations alone or text that is only raised."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Raise | ast.arg | ast.Import | ast.ImportFrom):
            yield from range(node.lineno, (node.end_lineno or node.lineno) + 1)


def test_command(module: Path, *, golden: bool) -> list[str]:
    """Return the command that tests a module: its folder's tests, and conformance for a kind.

    >>> test_command(Path("orthoflow/geometry/frames.py"), golden=True)[-1]
    'tests/geometry'
    """
    parts = module.parts
    wanted: list[str] = []
    if parts[0] == "plugins":
        kind = parts[2]
        wanted = [f"tests/plugins/{kind}", "tests/testing/test_conformance.py"]
        chosen = f"{kind} or not conform" + ("" if golden else " and not golden")
    else:
        folder = "provenance" if parts[0] == "provenance" else parts[1]
        name = f"tests/test_{module.stem}.py"
        wanted = [f"tests/{folder}"] if Path(ROOT, "tests", folder).is_dir() else [name]
        chosen = "" if golden else "not golden"
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider"]
    selected = ["-k", chosen] if chosen else []
    return [sys.executable, "-m", "pytest", *options, *selected, *wanted]


if __name__ == "__main__":
    sys.exit(main())
