"""The mutations of `tests/mutate.py`: what is changed, what is left alone, and which tests run."""

from __future__ import annotations

import ast
import json
import subprocess
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests import mutate
from tests.mutations import drawn, mutations_of

PATH = "orthoflow/engine/example.py"


def changes(source: str) -> dict[str, set[str]]:
    """Operator -> the lines that it makes, of a module."""
    text = textwrap.dedent(source).encode()
    found: dict[str, set[str]] = {}
    for mutation in mutations_of(text, PATH):
        changed = mutation.applied(text).decode()
        ast.parse(changed)
        line = changed.splitlines()[mutation.line - 1].strip()
        found.setdefault(mutation.kind, set()).add(line)
    return found


@pytest.mark.parametrize(
    ("source", "kind", "lines"),
    [
        ("a = b + c", "arithmetic", {"a = (b - c)"}),
        ("a = b - c * d", "arithmetic", {"a = (b + c * d)", "a = b - (c / d)"}),
        ("a += b", "arithmetic", {"a -= b"}),
        ("a = n < k", "comparison", {"a = (n >= k)", "a = (n <= k)"}),
        ("a = far_m < 0.5", "comparison", {"a = (far_m >= 0.5)"}),
        ("a = b == c", "comparison", {"a = (b != c)"}),
        ("a = b is None", "comparison", {"a = (b is not None)"}),
        ("a = b in c", "comparison", {"a = (b not in c)"}),
        ("a = b and c", "boolean", {"a = (b or c)"}),
        ("a = not b", "boolean", {"a = (b)"}),
        ("a = 99", "constant", {"a = (100)"}),
        ("a = 100", "constant", {"a = (200)"}),
        ("a = 0.25", "constant", {"a = (0.5)"}),
        ("a = 0.0", "constant", {"a = (1.0)"}),
        ("a = True", "constant", {"a = (False)"}),
        ("def f(a=2): ...", "constant", {"def f(a=(3)): ..."}),
        ("def f(*, a=False): ...", "constant", {"def f(*, a=(True)): ..."}),
        ("def f(): return g()", "return", {"def f(): return (None)"}),
        ("a = b if c else d", "branch", {"a = b if (True) else d", "a = b if (False) else d"}),
        ("if a:\n    b()", "branch", {"if (True):", "if (False):"}),
    ],
)
def test_each_operator_changes_what_it_says(source: str, kind: str, lines: set[str]) -> None:
    assert changes(source)[kind] == lines


@pytest.mark.parametrize(
    "source",
    [
        '"""Two + two."""',
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import x",
        'a: Final = "larger by " + "one"',
        'raise ValueError(f"{n + 1} of {k - 1}")',
        "assert n + 1 < 3",
        'ctx.progress(0.5 + 0.1, "half")',
        "class A:\n    def __repr__(self): return str(1 + 1)",
        "class A:\n    result_version: ClassVar[int] = 3",
        "@compiled(cache=True)\ndef f(): ...",
        "zip(a, b, strict=True)",
        "a: tuple[float, float]",
        "a = b / 'name'",
        "a = 1e-12",
        "_ROWS_AT_ONCE = 64",
        "BLOCK_POINTS: Final = 500_000",
        "_CACHE_BYTES: Final = 1 << 27",
        "json.dumps(a, indent=2)",
        "click.option('--a', show_default=True)",
        "_ROUNDS: Final = 20",
        "_CONVERGED_CELLS: Final = 0.002",
        "_NICENESS: Final = 19",
        "a = max(c, 1e-6)",
        "_STEPS_MOST: Final = 30",
        "_BAND_CELLS: Final = 1 << 23",
        "_ROW_RGB: Final = (235, 165, 20)",
        "_CONNECT_S: Final = 15.0",
        "_POINTS_MOST: Final = 2_000_000",
        "_CELLS_TOLD: Final = 1 << 25",
        "_BLOCK_ROWS: Final = 1024",
        "_LONGEST_PX: Final = 1400",
        "_SEED: Final = 1",
        "_WITH_NAMES: Final = Margins(left=0.7, right=0.1)",
        "Paint(kind=k, rgb=(214, 206, 190), reflectance=0.7)",
        "def f(*, cores: int = 1): ...",
        "class A:\n    cores: int = 1",
        "b.reshape(-1)",
        "cv2.polylines(picture, places, thickness=2)",
        "_ROWS_FIRST: Final = 4_096",
        "@compiled\ndef f(): a = np.empty((3, n), dtype=np.int32)",
        "@kernel_part\ndef f(): a = np.zeros(10)",
        "return None",
    ],
)
def test_what_no_test_should_hold_is_left_alone(source: str) -> None:
    assert changes(source) == {}


@pytest.mark.parametrize(
    "source",
    [
        "_PLACES_MOST: Final = 99_999",
        "_SHARE_MOST: Final = 0.5",
        "_BITS: Final = 1 << 22",
        "N_FIRST = (1, 2)",
        "LONGEST_SIDE_PX: Final = 1200",
        "_CELLS_FIRST: Final = 4_096",
        "@compiled\ndef f(): a = np.empty(n + 4)",
        "@compiled\ndef f(): a = np.full(3, 1)",
        "@compiled\ndef f(): b = a[3]",
        "def f(): a = np.zeros((0, 3))",
    ],
)
def test_what_small_data_meets_is_changed(source: str) -> None:
    assert changes(source) != {}


def test_an_expression_over_several_lines_is_changed_as_a_whole() -> None:
    text = b"a = (\n    b  # \xc3\xa4\n    + c\n)\nd = 1\n"
    arithmetic = next(item for item in mutations_of(text, PATH) if item.kind == "arithmetic")
    names: dict[str, int] = {"b": 5, "c": 3}
    exec(compile(arithmetic.applied(text), PATH, "exec"), {}, names)
    assert (names["a"], names["d"]) == (2, 1)


def test_a_seed_draws_each_line_once_and_the_same_again() -> None:
    text = "\n".join(f"a{n} = b{n} + {n}" for n in range(200)).encode()
    found = mutations_of(text, PATH)
    chosen = drawn(found, seed=5, count=40)
    assert chosen == drawn(found, seed=5, count=40) != drawn(found, seed=6, count=40)
    assert len({mutation.line for mutation in chosen}) == 40
    assert len(drawn(found, seed=5, count=1000)) == 200
    # Lines are as likely as each other, whatever there is on them.
    times = Counter(m.line for seed in range(300) for m in drawn(found, seed=seed, count=40))
    assert min(times.values()) > 25  # 60 expected, 7 their standard deviation
    assert max(times.values()) < 95


@pytest.fixture(scope="module")
def tree() -> mutate.Tree:
    return mutate.Tree.of(mutate.ROOT)


@pytest.mark.parametrize(
    ("path", "folder"),
    [
        ("orthoflow/engine/store.py", "tests/engine"),
        ("orthoflow/files/points/e57.py", "tests/files/points"),
        ("plugins/orthoflow_plugins/plane/ransac.py", "tests/plugins/plane"),
        ("provenance/orthoflow_provenance/verify.py", "tests/provenance"),
        ("orthoflow/geometry/planes.py", "tests/geometry"),
        ("orthoflow/errors.py", "tests/cli"),
    ],
)
def test_a_modules_tests_are_in_the_folder_of_its_name(
    tree: mutate.Tree, path: str, folder: str
) -> None:
    assert mutate.folders_of(tree, path)[0] == folder


def test_the_file_of_its_name_goes_first_and_kinds_follow_geometry(tree: mutate.Tree) -> None:
    near, others = mutate.files_of(tree, "plugins/orthoflow_plugins/plane/hough3d.py")
    assert near[0] == "tests/plugins/plane/test_hough3d.py"
    folders = ("tests/plugins/plane", "tests/plugins")
    there = [file for folder in folders for file in (mutate.ROOT / folder).glob("test_*.py")]
    assert sorted(near + others) == sorted(str(file.relative_to(mutate.ROOT)) for file in there)
    assert "tests/test_diagnostics.py" in mutate.files_of(tree, "orthoflow/diagnostics.py")[0][:2]
    folders = mutate.folders_of(tree, "orthoflow/geometry/threads.py")
    assert folders[0] == "tests/geometry"
    assert {"tests/plugins/plane", "tests/plugins/ortho"} <= set(folders)


def test_a_table_of_limits_and_files_that_import_a_module_belong_to_it(tree: mutate.Tree) -> None:
    near, others = mutate.files_of(tree, "orthoflow/files/survey_points.py")
    assert near == ["tests/files/test_survey_points.py", "tests/test_limits.py"]
    assert "tests/report/test_page.py" in others
    # `from orthoflow.files.clouds import photo_colours as module`
    _, others = mutate.files_of(tree, "orthoflow/files/clouds/photo_colours.py")
    assert others[-1] == "tests/plugins/colour/test_photos.py"


def test_importers_are_found_by_way_of_others(tree: mutate.Tree) -> None:
    assert "orthoflow.engine.child" in tree.importers("orthoflow.errors")
    assert tree.importers("orthoflow.__main__") == {"orthoflow.__main__"}


def test_kernels_hang_on_what_they_and_constants_are_made_of(tmp_path: Path) -> None:
    package = tmp_path / "orthoflow"
    texts = {
        "compiling": "",
        "errors": "class Error(Exception): ...",
        "scale": "SIGMA = 1.4826",
        "limits": "from orthoflow.scale import SIGMA\nMOST = 3 * SIGMA",
        "inner": "from orthoflow.geometry.compiling import compiled\n@compiled\ndef inner(): ...",
        "outer": """
from orthoflow.errors import Error
from orthoflow.geometry.compiling import compiled
from orthoflow.inner import inner
from orthoflow.limits import MOST as MOST_SIGMAS

@compiled
def outer():
    return inner() + MOST_SIGMAS

def checked():
    raise Error
""",
    }
    (package / "geometry").mkdir(parents=True)
    for name, text in texts.items():
        folder = package / "geometry" if name == "compiling" else package
        (folder / f"{name}.py").write_text(text)
    tree = mutate.Tree.of(tmp_path)
    inner, outer = "orthoflow/inner.py", "orthoflow/outer.py"
    assert tree.kernels_with("orthoflow.scale") == [outer]
    assert tree.kernels_with("orthoflow.inner") == [inner, outer]
    assert tree.kernels_with("orthoflow.outer") == [outer]
    assert tree.kernels_with("orthoflow.errors") == []
    every = ["orthoflow/geometry/compiling.py", inner, outer]
    assert tree.kernels_with("orthoflow.geometry.compiling") == every


SOURCE = b"SMALL = 1\nLARGE = 2\n"
MUTATION = next(
    item for item in mutations_of(SOURCE, "orthoflow/sizes.py") if item.change == "2 -> 3"
)
TESTS = """
from orthoflow import sizes


def test_that_fails_on_this_machine():
    assert not sizes


def test_sizes():
    assert sizes.LARGE == 2
"""


@pytest.fixture
def worker(tmp_path: Path) -> mutate.Worker:
    """Of a tree with one module and one file of tests."""
    root = tmp_path / "tree"
    (root / "orthoflow").mkdir(parents=True)
    (root / "tests/sizes").mkdir(parents=True)
    (root / "pyproject.toml").write_text("[tool.pytest.ini_options]\naddopts = ['-p', 'no:dash']\n")
    (root / "orthoflow/__init__.py").touch()
    (root / "orthoflow/sizes.py").write_bytes(SOURCE)
    (root / "tests/sizes/test_sizes.py").write_text(TESTS)
    return mutate.Worker(folder=tmp_path, timeout_s=90.0, budget_s=600.0)


def test_a_mutation_is_killed_by_a_test_that_passes_without_it(worker: mutate.Worker) -> None:
    verdict = worker.verdict(MUTATION, mutate.Tree.of(worker.tree))
    assert verdict.killer == "tests/sizes/test_sizes.py::test_sizes"
    assert (worker.tree / "orthoflow/sizes.py").read_bytes() == SOURCE


def test_a_file_of_tests_that_does_not_load_here_is_left_out(worker: mutate.Worker) -> None:
    (worker.tree / "tests/sizes/test_sizes.py").write_text("import no_such_library\n")
    assert worker.verdict(MUTATION, mutate.Tree.of(worker.tree)).killer == ""


@pytest.mark.parametrize(
    ("mutated", "unmutated", "killer"),
    [
        ((0, []), (0, []), ""),
        ((1, ["a.py::test_b"]), (0, []), "a.py::test_b"),
        ((1, ["a.py::test_b"]), (1, ["a.py::test_b"]), ""),
        ((None, []), (0, []), "timeout of 90 s"),
        ((None, []), (None, []), ""),
        ((-11, []), (0, []), "pytest: it says"),
    ],
    ids=["passes", "fails", "fails-anyway", "hangs", "takes-as-long-anyway", "crashes"],
)
def test_what_a_run_without_the_mutation_does_not_tell_apart_kills_nothing(
    worker: mutate.Worker,
    monkeypatch: pytest.MonkeyPatch,
    mutated: tuple[int | None, list[str]],
    unmutated: tuple[int | None, list[str]],
    killer: str,
) -> None:
    def run(
        self: mutate.Worker, arguments: Sequence[str], _: Path, __: float
    ) -> subprocess.CompletedProcess[str] | None:
        is_mutated = (self.tree / "orthoflow/sizes.py").read_bytes() != SOURCE
        code, failed = mutated if is_mutated else unmutated
        if set(failed) <= set(self._broken):
            code, failed = (0, []) if failed else (code, failed)
        cache = self.folder / "cache/v/cache"
        cache.mkdir(parents=True, exist_ok=True)
        (cache / "lastfailed").write_text(json.dumps(dict.fromkeys(failed, True)))
        return None if code is None else subprocess.CompletedProcess(arguments, code, "it says", "")

    monkeypatch.setattr(mutate.Worker, "_pytest", run)
    assert worker.verdict(MUTATION, mutate.Tree.of(worker.tree)).killer == killer
