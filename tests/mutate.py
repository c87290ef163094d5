"""Mutations of the source that tests should notice: `python tests/mutate.py --seed 1`.

Draws places of the source by a seed, changes one after the other, runs the tests of the changed
module and says what lives. Exit code 0 when nine of ten were killed, else 1; 2 when the tests fail
before anything is changed.

A place is a line with something to mutate. What is done to it:

- arithmetic: `+` for `-`, `*` for `/`, and the other way round;
- comparison: turned round (`<` to `>=`, `==` to `!=`, `in` to `not in`), or its bound moved (`<` to
  `<=`) where both sides may be whole numbers: floats hardly ever meet their bound;
- boolean: `and` for `or`, `not` left out, `True` for `False`;
- constant: a whole number one more, from 100 on doubled, as is a float (0.0 to 1.0); likewise
  defaults of arguments;
- return: the value dropped;
- branch: always taken, never taken.

Left alone is what no test should hold: docstrings, annotations, decorators, what only type checkers
read, messages and whatever else an exception is raised with, log and progress lines, `__repr__`,
assertions of what cannot happen, version numbers of results, what changes speed or looks alone
(threads, sizes of parts and caches, arguments of drawings, floats below a millionth that guard a
division) and how often a search goes on at most: one that has converged moves no more.

The tests of `orthoflow/engine/x.py` are those in `tests/engine`, of a plugin's module those of its
kind, of `orthoflow/geometry` those in `tests/geometry` and of the kinds that import it. Doctests
and a file of the module's own name go first, then those that name the module; the first failure
ends a run. The conformance suite takes part for modules of kinds, its golden results last: they
hold what a method gives, too, but a killer that knows why a number is right says more. A run that
takes far longer than without a mutation is stopped, which kills the mutation as well.

All this happens in copies of the tree, kept in the temporary folder (`--work`) between runs for the
sake of compiled kernels. Numba's cache does not notice that a kernel which another one calls has
changed. So a run gets a copy of the cache, hard links, without what the changed module and the
modules that import it compiled.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.mutations import Mutation, drawn, mutations_of  # noqa: E402 - also run as a script

# Folder of a package's parent -> package.
PACKAGES: Final = {
    ".": "orthoflow",
    "plugins": "orthoflow_plugins",
    "provenance": "orthoflow_provenance",
}
COPIED: Final = (
    *("orthoflow", "plugins", "provenance", "tests", "workflows", "docs", "examples"),
    *("benchmarks", "pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE"),
)
KILLED_SHARE: Final = 0.9
# Exit codes of pytest.
_MISUSED: Final = 4
_NOTHING_FOUND: Final = 5


# --- which tests ---


@dataclass(frozen=True, kw_only=True)
class Tree:
    """The modules of a checkout and which of them import which.

    Attributes:
        root: of the checkout.
        modules: dotted name -> path from the root.
        imports: dotted name -> names of modules that it imports, anywhere in its text.
    """

    root: Path
    modules: dict[str, str]
    imports: dict[str, frozenset[str]]

    @classmethod
    def of(cls, root: Path) -> Tree:
        """Read the sources."""
        modules = {}
        for parent, package in PACKAGES.items():
            for path in sorted((root / parent / package).rglob("*.py")):
                parts = path.relative_to(root / parent).with_suffix("").parts
                name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
                modules[name] = str(path.relative_to(root))
        imports = {
            name: frozenset(_imported(ast.parse((root / path).read_bytes())) & modules.keys())
            for name, path in modules.items()
        }
        return cls(root=root, modules=modules, imports=imports)

    def name(self, path: str) -> str:
        """The dotted name of a module's path."""
        return next(name for name, known in self.modules.items() if known == path)

    def importers(self, name: str) -> set[str]:
        """Give the modules that import a module, also by way of others, and itself."""
        found, new = {name}, {name}
        while new:
            new = {other for other, all_of in self.imports.items() if all_of & new} - found
            found |= new
        return found


def _imported(tree: ast.Module) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def folders_of(tree: Tree, path: str) -> list[str]:
    """Give the folders of tests of a module, its own first."""
    name = tree.name(path)
    package, *rest = name.split(".")
    if package == "orthoflow_plugins":
        own = [f"tests/plugins/{rest[0]}"] if rest else []
    elif package == "orthoflow_provenance":
        own = ["tests/provenance"]
    else:
        own = [f"tests/{'/'.join(rest[:depth])}" for depth in range(len(rest), 0, -1)]
    if rest[:1] == ["geometry"]:
        kinds = {other.split(".")[1] for other in _kind_modules(tree.importers(name))}
        direct = {
            other.split(".")[1]
            for other in _kind_modules(
                {other for other, known in tree.imports.items() if name in known}
            )
        }
        own += [
            f"tests/plugins/{kind}" for kind in sorted(kinds, key=lambda k: (k not in direct, k))
        ]
    found = [folder for folder in own if (tree.root / folder).is_dir()]
    return found or ["tests/cli"]


def _kind_modules(names: set[str]) -> set[str]:
    return {name for name in names if name.startswith("orthoflow_plugins.") and name.count(".") > 1}


def files_of(tree: Tree, path: str) -> list[str]:
    """Give the files of tests of a module, those that know most of it first."""
    name = tree.name(path)
    stem = Path(path).stem

    def turn(place: int, file: Path) -> tuple[int, int, str]:
        text = file.read_text(encoding="utf-8")
        own = file.stem.removeprefix("test_")
        if own == stem:
            return 0, place, file.name
        named = name in text or f"import {stem}" in text
        return (1 if named else 2 if own in stem or stem in own else 3), place, file.name

    ranked = [
        (turn(place, file), str(file.relative_to(tree.root)))
        for place, folder in enumerate(folders_of(tree, path))
        for file in sorted((tree.root / folder).rglob("test_*.py"))
    ]
    if len(name.split(".")) == 2 and (tree.root / f"tests/test_{stem}.py").is_file():
        # Of a module beside the packages, as its tests are.
        ranked.append(((0, 0, ""), f"tests/test_{stem}.py"))
    if kinds_of(tree, path):
        # What holds for the methods of all kinds.
        shared = sorted((tree.root / "tests/plugins").glob("test_*.py"))
        ranked += [((4, 0, file.name), str(file.relative_to(tree.root))) for file in shared]
    if ">>> " in (tree.root / path).read_text(encoding="utf-8"):
        ranked.append(((-1, 0, ""), path))
    return list(dict.fromkeys(file for _, file in sorted(ranked)))


def kinds_of(tree: Tree, path: str) -> list[str]:
    """Give the kinds whose methods a module is part of."""
    return [
        folder.rpartition("/")[2]
        for folder in folders_of(tree, path)
        if folder.startswith("tests/plugins/")
    ]


# --- running ---


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of a mutation; `killer` is empty where it lives."""

    mutation: Mutation
    killer: str
    seconds: float


@dataclass
class Worker:
    """A copy of the tree in which one mutation after the other is tried.

    Attributes:
        folder: what it has for itself.
        least_timeout_s: how long any run may take.
    """

    folder: Path
    least_timeout_s: float
    _usual_s: dict[str, float] = field(default_factory=dict)
    _broken: list[str] = field(default_factory=list)
    _stamp: int = 0

    @property
    def tree(self) -> Path:
        """The copy."""
        return self.folder / "tree"

    def prepare(self, source: Path) -> None:
        """Copy the tree afresh; times of files stay, by which kernels are known."""
        if self.tree.exists():
            shutil.rmtree(self.tree)
        self.tree.mkdir(parents=True)
        ignored = shutil.ignore_patterns("__pycache__", ".git", "*.pyc", "runs")
        for name in COPIED:
            if (source / name).is_dir():
                shutil.copytree(source / name, self.tree / name, ignore=ignored, symlinks=True)
            elif (source / name).is_file():
                shutil.copy2(source / name, self.tree / name)
        # The real scans lie beside a checkout.
        shared, beside = self.folder / "shared", source.parent / "shared"
        if beside.is_dir() and not shared.exists():
            shared.symlink_to(beside)

    def first_problem(self, folders: Sequence[str]) -> str:
        """Run folders of tests without a mutation, to know how long they take."""
        for folder in folders:
            if folder in self._usual_s:
                continue
            began = time.monotonic()
            report = self.folder / "report.xml"
            done = self._pytest([folder, f"--junitxml={report}"], self._kernels, 3600.0)
            self._usual_s[folder] = time.monotonic() - began
            if done is None or done.returncode not in (0, 1, _NOTHING_FOUND):
                return f"{folder} does not run: {'' if done is None else done.stdout[-2000:]}"
            if done.returncode == 1:
                failed = _failed(report)
                sys.stderr.write(f"not counted, fail without a mutation: {', '.join(failed)}\n")
                self._broken += failed
        return ""

    def verdict(self, mutation: Mutation, tree: Tree) -> Verdict:
        """Try a mutation."""
        began = time.monotonic()
        target = self.tree / mutation.path
        before = target.stat()
        source = target.read_bytes()
        kernels = self._kernels_without(mutation, tree)
        try:
            target.write_bytes(mutation.applied(source))
            # Interpreters know compiled modules by whole seconds and size.
            self._stamp += 10
            os.utime(target, (before.st_atime, before.st_mtime + self._stamp))
            killer = self._killer(mutation, tree, kernels)
        finally:
            target.write_bytes(source)
            os.utime(target, ns=(before.st_atime_ns, before.st_mtime_ns))
            if kernels != self._kernels:
                shutil.rmtree(kernels, ignore_errors=True)
        return Verdict(mutation=mutation, killer=killer, seconds=time.monotonic() - began)

    def _killer(self, mutation: Mutation, tree: Tree, kernels: Path) -> str:
        usual_s = sum(self._usual_s.get(folder, 0.0) for folder in folders_of(tree, mutation.path))
        timeout_s = self.least_timeout_s + 3.0 * usual_s
        runs = [["-x", *files_of(tree, mutation.path)]]
        if kinds := kinds_of(tree, mutation.path):
            named = " or ".join(f"{kind}." for kind in kinds)
            runs += [
                ["-x", "tests/testing/test_conformance.py", "-k", f"({named}) and {which}"]
                for which in ("not golden", "golden")
            ]
        for arguments in runs:
            done = self._pytest(arguments, kernels, timeout_s)
            if done is None:
                return f"timeout of {timeout_s:.0f} s"
            if done.returncode == _MISUSED:
                raise RuntimeError(f"pytest does not take its arguments: {done.stdout[-500:]}")
            if done.returncode not in (0, _NOTHING_FOUND):
                return _named_failure(done.stdout)
        return ""

    def _pytest(
        self, arguments: Sequence[str], kernels: Path, timeout_s: float
    ) -> subprocess.CompletedProcess[str] | None:
        """Run pytest on the copy; None when it took too long, with all its processes gone."""
        parts = [str(self.tree / parent) for parent in PACKAGES]
        scratch = self.folder / "tmp"
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(parts),
            "NUMBA_CACHE_DIR": str(kernels),
            "MPLBACKEND": "Agg",
            "TMPDIR": str(scratch),
        }
        deselected = [part for name in self._broken for part in ("--deselect", name)]
        command = [
            *(sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider"),
            *(*deselected, *arguments),
        ]
        with subprocess.Popen(
            command,
            cwd=self.tree,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        ) as process:
            try:
                said, _ = process.communicate(timeout=timeout_s)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                return None
        return subprocess.CompletedProcess(command, process.returncode, said, "")

    @property
    def _kernels(self) -> Path:
        """The folder of compiled kernels of the tree as it is."""
        return self.folder / f"kernels-{_kernel_state(self.tree)}"

    def _kernels_without(self, mutation: Mutation, tree: Tree) -> Path:
        """Give a cache without what hangs on a module; the usual one where nothing does."""
        importers = tree.importers(tree.name(mutation.path))
        hanging = [
            path for name in importers if _compiles(tree.root / (path := tree.modules[name]))
        ]
        if not hanging or not self._kernels.is_dir():
            return self._kernels
        other = self.folder / "kernels-mutated"
        shutil.rmtree(other, ignore_errors=True)
        shutil.copytree(self._kernels, other, copy_function=os.link)
        for path in hanging:
            # Numba names folders after the module's folder and its digest, files after the module.
            parent = (self.tree / path).parent
            digest = hashlib.sha1(str(parent).encode()).hexdigest()
            for file in (other / f"{parent.name}_{digest}").glob(f"{Path(path).stem}.*"):
                file.unlink()
        return other


@cache
def _compiles(path: Path) -> bool:
    return b"orthoflow.geometry.compiling" in path.read_bytes() or path.stem == "compiling"


def _kernel_state(root: Path) -> str:
    """Digest of all modules that compile something: callers do not know of what they call."""
    digest = hashlib.sha256()
    for parent, package in PACKAGES.items():
        for path in sorted((root / parent / package).rglob("*.py")):
            if _compiles(path):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _failed(report: Path) -> list[str]:
    found = []
    for case in ET.parse(report).iter("testcase"):
        if case.find("failure") is not None or case.find("error") is not None:
            file = case.get("classname", "").replace(".", "/") + ".py"
            found.append(f"{file}::{case.get('name')}")
    return found


def _named_failure(said: str) -> str:
    found = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", said, flags=re.MULTILINE)
    return found[1] if found else (said.strip().splitlines() or ["pytest died"])[-1]


def _shared_out(mutations: Sequence[Mutation], tree: Tree, n_workers: int) -> list[list[Mutation]]:
    """Deal out mutations; those with the same tests go to the same worker: its kernels are warm."""
    groups: dict[str, list[Mutation]] = defaultdict(list)
    for mutation in mutations:
        groups[folders_of(tree, mutation.path)[0]].append(mutation)
    shares: list[list[Mutation]] = [[] for _ in range(n_workers)]
    for _, group in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        min(shares, key=len).extend(group)
    return shares


def run(
    mutations: Sequence[Mutation],
    *,
    work: Path,
    n_workers: int,
    timeout_s: float,
    is_checked: bool,
    tell: Callable[[Verdict], None],
) -> list[Verdict]:
    """Try mutations and give their verdicts.

    Raises:
        RuntimeError: tests do not run without any mutation.
    """
    tree = Tree.of(ROOT)
    verdicts: list[Verdict] = []
    problems: list[str] = []
    lock = threading.Lock()

    def work_off(number: int, share: Sequence[Mutation]) -> None:
        worker = Worker(folder=work / f"worker-{number}", least_timeout_s=timeout_s)
        worker.prepare(ROOT)
        # Which tests there are is asked of the copy: the checkout may go on.
        tree = Tree.of(worker.tree)
        for mutation in share:
            folders = folders_of(tree, mutation.path) if is_checked else []
            if problem := worker.first_problem(folders):
                problems.append(problem)
                return
            try:
                verdict = worker.verdict(mutation, tree)
            except RuntimeError as error:
                problems.append(str(error))
                return
            with lock:
                verdicts.append(verdict)
                tell(verdict)

    threads = [
        threading.Thread(target=work_off, args=(number, share))
        for number, share in enumerate(_shared_out(mutations, tree, n_workers))
        if share
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if problems:
        raise RuntimeError("; ".join(problems))
    return verdicts


def all_mutations(only: Sequence[str] = ()) -> Iterator[Mutation]:
    """Give all mutations of the source, or of the paths that begin with one of some prefixes."""
    for parent, package in PACKAGES.items():
        for path in sorted((ROOT / parent / package).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if not only or name.startswith(tuple(only)):
                yield from mutations_of(path.read_bytes(), name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="draws the places")
    parser.add_argument("--count", type=int, default=40, help="number of places")
    parser.add_argument("--only", nargs="*", default=[], help="beginnings of paths")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--timeout", type=float, default=150.0, help="seconds, least of a run")
    parser.add_argument(
        "--work",
        type=Path,
        default=Path(tempfile.gettempdir())
        / f"orthoflow-mutate-{hashlib.sha256(str(ROOT).encode()).hexdigest()[:8]}",
    )
    parser.add_argument(
        "--unchecked", action="store_true", help="do not run the tests without mutations first"
    )
    parser.add_argument("--list", action="store_true", help="print what is drawn, run nothing")
    given = parser.parse_args(arguments)
    mutations = drawn(list(all_mutations(given.only)), seed=given.seed, count=given.count)
    _say(f"seed {given.seed}: {len(mutations)} places")
    if given.list:
        _say("\n".join(map(str, mutations)))
        return 0
    try:
        verdicts = run(
            mutations,
            work=given.work,
            n_workers=given.jobs,
            timeout_s=given.timeout,
            is_checked=not given.unchecked,
            tell=_print,
        )
    except RuntimeError as error:
        _say(error)
        return 2
    killed = [verdict for verdict in verdicts if verdict.killer]
    for verdict in verdicts:
        if not verdict.killer:
            _say(f"lives: {verdict.mutation}")
    _say(f"seed {given.seed}: killed {len(killed)} of {len(verdicts)}")
    return 0 if len(killed) >= KILLED_SHARE * len(verdicts) else 1


def _say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def _print(verdict: Verdict) -> None:
    fate = f"killed by {verdict.killer}" if verdict.killer else "SURVIVED"
    _say(f"{verdict.mutation} | {fate} | {verdict.seconds:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
