"""Mutations of the source that tests should notice: `python tests/mutate.py --seed 1`.

Draws places of the source by a seed, changes one after the other, runs the tests of the changed
module and says what lives. Exit code 0 when nine of ten were killed, else 1; 2 when pytest itself
does not run.

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
(threads, sizes of parts, bands and caches, the room of arrays that kernels make for themselves and
that tables which grow begin with, from how many on, a hundred thousand or more, a part is
looked at in place of all, the priority of processes, arguments, margins and sizes of drawings,
colours and paints, floats of a millionth or less that guard a division), which seed samples begin
with, how long another process is waited for at most, how often a search goes on at most, and from
which step on it has converged: it moves no more than that.

The tests of `orthoflow/engine/x.py` are those in `tests/engine`, of a plugin's module those of its
kind, of `orthoflow/geometry` those in `tests/geometry` and of the kinds that import it. Doctests,
a file of the module's own name, files that name the module and, where `docs/limits.md` states a
limit of it, the test of that table go first, in a run of their own that has little to collect; then
the conformance suite for modules of kinds; then the other files, and files of other folders that
import the module itself. The first failure ends a run.

A test kills a mutation only when it passes without it: whatever failed is run once more on the
source as it is. What fails there as well is left out from then on. A run that takes too long
(`--timeout`) kills where the same run, without the mutation, takes less than a third of that; else,
and where `--budget` is spent, the mutation counts as alive.

All this happens in copies of the tree, kept in the temporary folder (`--work`) between runs for the
sake of compiled kernels. Numba's cache does not notice that a kernel which another one calls has
changed. So a run gets a copy of the cache, hard links, without what could differ: the kernels of
the changed module and of all that take kernels or constants from it, if only by way of others
(`Tree.kernels_with`).
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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
_COMPILING: Final = "orthoflow.geometry.compiling"
# What is computed when a module is loaded.
_COMPUTED: Final = (ast.Assign, ast.AnnAssign, ast.If, ast.For)
# Exit codes of pytest.
_PASSED: Final = 0
_FAILED: Final = 1
_NOTHING_FOUND: Final = 5


# --- which tests ---


@dataclass(frozen=True, kw_only=True)
class Tree:
    """The modules of a checkout and which of them import which.

    Attributes:
        root: of the checkout.
        modules: dotted name -> path from the root.
        imports: dotted name -> names of modules that it imports, anywhere in its text.
        frozen: dotted name -> names of modules of which kernels or constants of it are made.
    """

    root: Path
    modules: dict[str, str]
    imports: dict[str, frozenset[str]]
    frozen: dict[str, frozenset[str]]

    @classmethod
    def of(cls, root: Path) -> Tree:
        """Read the sources."""
        modules = {}
        for parent, package in PACKAGES.items():
            for path in sorted((root / parent / package).rglob("*.py")):
                parts = path.relative_to(root / parent).with_suffix("").parts
                name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
                modules[name] = str(path.relative_to(root))
        texts = {name: ast.parse((root / path).read_bytes()) for name, path in modules.items()}
        return cls(
            root=root,
            modules=modules,
            imports={n: frozenset(_imported(text) & modules.keys()) for n, text in texts.items()},
            frozen={n: frozenset(_frozen(text) & modules.keys()) for n, text in texts.items()},
        )

    def name(self, path: str) -> str:
        """The dotted name of a module's path."""
        return next(name for name, known in self.modules.items() if known == path)

    def importers(self, name: str) -> set[str]:
        """Give the modules that import a module, also by way of others, and itself."""
        return _reached(name, self.imports)

    def kernels_with(self, name: str) -> list[str]:
        """Give the paths of modules whose compiled kernels may differ when a module does."""
        paths = [self.modules[other] for other in _reached(name, self.frozen)]
        return sorted(path for path in paths if _compiles(self.root / path))


def _reached(name: str, edges: Mapping[str, frozenset[str]]) -> set[str]:
    found, new = {name}, {name}
    while new:
        new = {other for other, all_of in edges.items() if all_of & new} - found
        found |= new
    return found


def _frozen(tree: ast.Module) -> set[str]:
    """Names of modules that kernels and constants of a module are made of.

    Numba freezes what a kernel finds in its module: kernels, numbers, tables. So this follows the
    names in compiled functions, and in whatever is computed when a module is loaded.
    """
    sources = _sources_of_names(tree)
    used = {name for item in tree.body if isinstance(item, _COMPUTED) for name in _names(item)}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            decorators = {name for item in node.decorator_list for name in _names(item)}
            if any(_COMPILING in sources.get(name, ()) for name in decorators):
                used |= _names(node)
    return {module for name in used for module in sources.get(name, ())}


def _sources_of_names(tree: ast.Module) -> dict[str, set[str]]:
    """Name in a module -> the modules that it may come from."""
    sources: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                sources[(alias.asname or alias.name).partition(".")[0]] = {alias.name}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                places = {node.module, f"{node.module}.{alias.name}"}
                sources[alias.asname or alias.name] = places
    return sources


def _names(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


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


def _files_importing(root: Path, name: str) -> list[str]:
    """Files of tests, wherever they stand, that import a module itself."""
    return [file for file, names in _imports_of_tests(root).items() if name in names]


@cache
def _imports_of_tests(root: Path) -> dict[str, frozenset[str]]:
    files = sorted((root / "tests").rglob("test_*.py"))
    return {
        str(file.relative_to(root)): frozenset(_imported(ast.parse(file.read_bytes())))
        for file in files
    }


def _kind_modules(names: set[str]) -> set[str]:
    return {name for name in names if name.startswith("orthoflow_plugins.") and name.count(".") > 1}


def files_of(tree: Tree, path: str) -> tuple[list[str], list[str]]:
    """Give the files of tests of a module, first those that name it, then the others."""
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
    limits = tree.root / "docs/limits.md"
    if limits.is_file() and f"`{name}." in limits.read_text(encoding="utf-8"):
        ranked.append(((1, 0, "test_limits.py"), "tests/test_limits.py"))
    if ">>> " in (tree.root / path).read_text(encoding="utf-8"):
        ranked.append(((-1, 0, ""), path))
    ranked += [((5, 0, file), file) for file in _files_importing(tree.root, name)]
    near = [file for (rank, *_), file in sorted(ranked) if rank <= 1]
    return list(dict.fromkeys(near)), list(
        dict.fromkeys(file for _, file in sorted(ranked) if file not in near)
    )


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
        timeout_s: how long a run may take.
        budget_s: how long a mutation may take; it is not begun another run with after that.
    """

    folder: Path
    timeout_s: float
    budget_s: float
    _broken: list[str] = field(default_factory=list)

    @property
    def tree(self) -> Path:
        """The copy."""
        return self.folder / "tree"

    @property
    def _kernels(self) -> Path:
        return self.folder / "kernels"

    def prepare(self, source: Path) -> None:
        """Copy the tree afresh; times of files stay, by which kernels are known."""
        before = _sources(self.tree)
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
        now, tree = _sources(self.tree), Tree.of(self.tree)
        for name, path in tree.modules.items():
            if before.get(path) != now[path]:
                _forget(self._kernels, self.tree, tree.kernels_with(name))

    def verdict(self, mutation: Mutation, tree: Tree) -> Verdict:
        """Try a mutation."""
        began = time.monotonic()
        killer = ""
        with self._kernels_without(mutation, tree) as kernels:
            for arguments in _runs(mutation, tree):
                if time.monotonic() - began > self.budget_s:
                    break
                if killer := self._killer([*arguments, "-x"], mutation, kernels):
                    break
        return Verdict(mutation=mutation, killer=killer, seconds=time.monotonic() - began)

    def _killer(self, arguments: Sequence[str], mutation: Mutation, kernels: Path) -> str:
        """What fails in a run with a mutation and passes without it; else an empty text."""
        while True:
            with self._mutated(mutation):
                done = self._pytest(arguments, kernels, self.timeout_s)
            if done is None:
                again = self._pytest(arguments, self._kernels, self.timeout_s / 3)
                is_slower = again is not None and again.returncode == _PASSED
                return f"timeout of {self.timeout_s:.0f} s" if is_slower else ""
            if done.returncode in (_PASSED, _NOTHING_FOUND):
                return ""
            failed = self._last_failed()
            again = self._pytest(failed or arguments, self._kernels, 3600.0)
            if again is not None and again.returncode == _PASSED:
                return failed[0] if failed else f"pytest: {done.stdout.strip()[-200:]}"
            if failed:
                # What else fails there is asked once, not one test after the other.
                files = dict.fromkeys(name.partition("::")[0] for name in failed)
                again = self._pytest(list(files), self._kernels, 3600.0)
            broken = self._last_failed()
            if again is None or not set(broken) - set(self._broken):
                raise RuntimeError(f"pytest does not run: {'' if again is None else again.stdout}")
            sys.stderr.write(f"not counted, fail without a mutation: {', '.join(broken)}\n")
            self._broken += broken

    @contextmanager
    def _kernels_without(self, mutation: Mutation, tree: Tree) -> Iterator[Path]:
        """Give a folder of kernels without those that could differ with a mutation."""
        hanging = tree.kernels_with(tree.name(mutation.path))
        if not hanging:
            yield self._kernels
            return
        kernels = self.folder / "kernels-mutated"
        shutil.rmtree(kernels, ignore_errors=True)
        self._kernels.mkdir(exist_ok=True)
        shutil.copytree(self._kernels, kernels, copy_function=os.link)
        _forget(kernels, self.tree, hanging)
        yield kernels
        # What else was compiled meanwhile is the same without the mutation.
        _forget(kernels, self.tree, hanging)
        for file in kernels.glob("*/*.nb[ci]"):
            kept = self._kernels / file.relative_to(kernels)
            kept.parent.mkdir(exist_ok=True)
            file.replace(kept)

    @contextmanager
    def _mutated(self, mutation: Mutation) -> Iterator[None]:
        """Change the copy for a while."""
        target = self.tree / mutation.path
        before = target.stat()
        source = target.read_bytes()
        try:
            target.write_bytes(mutation.applied(source))
            # Interpreters and numba know what they have compiled by whole seconds and size.
            digest = hashlib.sha256(str(mutation).encode()).digest()
            os.utime(target, (before.st_atime, before.st_mtime + 1 + int.from_bytes(digest[:3])))
            yield
        finally:
            target.write_bytes(source)
            os.utime(target, ns=(before.st_atime_ns, before.st_mtime_ns))

    def _last_failed(self) -> list[str]:
        found = self.folder / "cache/v/cache/lastfailed"
        return list(json.loads(found.read_text())) if found.is_file() else []

    def _pytest(
        self, arguments: Sequence[str], kernels: Path, timeout_s: float
    ) -> subprocess.CompletedProcess[str] | None:
        """Run pytest on the copy; None when it took too long, with all its processes gone."""
        parts = [str(self.tree / parent) for parent in PACKAGES]
        scratch = self.folder / "tmp"
        for left in (scratch, self.folder / "cache"):
            shutil.rmtree(left, ignore_errors=True)
        scratch.mkdir(parents=True)
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(parts),
            "NUMBA_CACHE_DIR": str(kernels),
            "MPLBACKEND": "Agg",
            "TMPDIR": str(scratch),
        }
        deselected = [f"--deselect={name}" for name in self._broken if "::" in name]
        # Of a file that cannot be collected nothing can be left out.
        named = [argument for argument in arguments if argument not in self._broken]
        command = [
            *(sys.executable, "-m", "pytest", "-q", "-n", "0"),
            *("-o", f"cache_dir={self.folder / 'cache'}"),
            *(*deselected, *named),
        ]
        if not any(".py" in argument for argument in named):
            return subprocess.CompletedProcess(command, _NOTHING_FOUND, "", "")
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


def _runs(mutation: Mutation, tree: Tree) -> Iterator[list[str]]:
    """Give the arguments of pytest, one run after the other, of the tests of a module."""
    near, others = files_of(tree, mutation.path)
    if near:
        yield near
    if kinds := kinds_of(tree, mutation.path):
        named = " or ".join(f"{kind}." for kind in kinds)
        yield ["tests/testing/test_conformance.py", "-k", named]
    if others:
        yield others


def _sources(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for parent, package in PACKAGES.items()
        for path in (root / parent / package).rglob("*.py")
    }


def _forget(kernels: Path, root: Path, paths: Sequence[str]) -> None:
    """Remove what was compiled of modules."""
    for path in paths:
        # Numba names folders after the module's folder and its digest, files after the module.
        parent = (root / path).parent
        digest = hashlib.sha1(str(parent).encode()).hexdigest()
        for file in (kernels / f"{parent.name}_{digest}").glob(f"{Path(path).stem}.*"):
            file.unlink()


@cache
def _compiles(path: Path) -> bool:
    return b"orthoflow.geometry.compiling" in path.read_bytes() or path.stem == "compiling"


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
    budget_s: float,
    tell: Callable[[Verdict], None],
) -> list[Verdict]:
    """Try mutations and give their verdicts.

    Raises:
        RuntimeError: pytest does not run.
    """
    tree = Tree.of(ROOT)
    verdicts: list[Verdict] = []
    problems: list[str] = []
    lock = threading.Lock()

    def work_off(number: int, share: Sequence[Mutation]) -> None:
        worker = Worker(folder=work / f"worker-{number}", timeout_s=timeout_s, budget_s=budget_s)
        worker.prepare(ROOT)
        # Which tests there are is asked of the copy: the checkout may go on.
        tree = Tree.of(worker.tree)
        for mutation in share:
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
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds, of a run")
    parser.add_argument("--budget", type=float, default=1800.0, help="seconds, of a mutation")
    parser.add_argument(
        "--work",
        type=Path,
        default=Path(tempfile.gettempdir())
        / f"orthoflow-mutate-{hashlib.sha256(str(ROOT).encode()).hexdigest()[:8]}",
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
            budget_s=given.budget,
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
