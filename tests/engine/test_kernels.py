"""Compiled kernels lie in a private folder of the user; what lies elsewhere is never loaded."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import pytest

from orthoflow.cli import plugins, warm
from orthoflow.engine import kernels
from orthoflow.engine.kernels import VARIABLE, all_kernels, is_private, kernel_folder
from orthoflow.workflow.source import shipped_workflow
from tests.optional import skip_unless
from tests.studios import asked
from tests.workshop_runs import WORKSHOP, orthoflow, write_studio


class _Hostile:
    """What runs a program when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return (os.mkdir, (str(self.mark),))


def _files(folder: Path) -> dict[Path, bytes]:
    found = (path for path in folder.rglob("*.nb?") if path.is_file())
    return {path.relative_to(folder): path.read_bytes() for path in found}


@pytest.fixture
def compiled(tmp_path: Path) -> dict[Path, bytes]:
    """Numba's files of a run in `tmp_path`, below its folder for all kernels."""
    write_studio(tmp_path, "paint.kernel")
    environment = {"XDG_CACHE_HOME": str(tmp_path / "first"), VARIABLE: ""}
    orthoflow(tmp_path, "run", "studio.yaml", "-o", "first-run", environment=environment, code=0)
    # Nothing executable lies in a store.
    endings = {path.suffix for path in (tmp_path / ".orthoflow").rglob("*") if path.is_file()}
    assert not endings & {".nbi", ".nbc", ".pkl", ".pickle", ".py", ".pyc", ".so", ".o"}
    found = _files(tmp_path / "first" / "orthoflow" / "numba")
    assert {path.suffix for path in found} == {".nbi", ".nbc"}
    return found


def test_only_the_private_folder_of_the_user_is_read(
    tmp_path: Path, compiled: dict[Path, bytes]
) -> None:
    mark = tmp_path / "executed"
    hostile = pickle.dumps(_Hostile(mark))
    world_writable = tmp_path / "shared"
    names = (".orthoflow/numba", "numba", "__pycache__", ".", "shared")
    for place in (tmp_path / name for name in names):
        for name in compiled:
            # With the state of the code and the module in their paths, and without.
            for path in (place / name, place.joinpath(*name.parts[1:]), place / name.name):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(hostile)
    world_writable.chmod(0o777)
    cache = tmp_path / "second"
    environment = {"XDG_CACHE_HOME": str(cache), VARIABLE: str(world_writable)}
    arguments = ["run", "studio.yaml", "--force", "paint", "-o"]
    orthoflow(tmp_path, *arguments, "second-run", environment=environment, code=0)
    assert not mark.exists()
    own = _files(cache)
    assert {path.name.partition(".")[0] for path in own} == {
        path.name.partition(".")[0] for path in compiled
    }
    assert hostile not in own.values()
    # What would be loaded if it were looked at: the same file where numba keeps its own.
    for path in _files(cache):
        (cache / path).write_bytes(hostile)
    orthoflow(tmp_path, *arguments, "third-run", environment=environment)
    assert mark.exists()
    # Files that were cut off are compiled again, a debugging setting does not reach steps.
    root = tmp_path / "first" / "orthoflow" / "numba"
    for number, (path, content) in enumerate(compiled.items()):
        (root / path).write_bytes(content[: 40 * (number % 2)])
    environment = {"XDG_CACHE_HOME": str(tmp_path / "first"), VARIABLE: ""}
    environment["NUMBA_DISABLE_JIT"] = "1"
    orthoflow(tmp_path, *arguments, "fourth-run", environment=environment, code=0)


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o722])
def test_a_folder_that_others_may_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(mode)
    assert not is_private(shared)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    monkeypatch.setenv(VARIABLE, str(shared))
    assert all_kernels() == tmp_path / "own" / "orthoflow" / "numba"
    assert (tmp_path / "own" / "orthoflow" / "numba").stat().st_mode & 0o777 == 0o700
    (tmp_path / "own" / "orthoflow").chmod(mode)
    for folder in (kernels.private_folder("numba"), kernel_folder("ab")):
        assert tmp_path not in folder.parents
        assert is_private(folder)
    monkeypatch.setenv(VARIABLE, "relative")
    assert tmp_path not in all_kernels().parents


@skip_unless(os.geteuid() == 0, "right", "only root can give folders away")
def test_a_folder_of_another_user_is_not_used(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    os.chown(tmp_path, 65534, -1)
    assert not is_private(tmp_path)


def test_old_states_of_the_code_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for nth in range(10):
        os.utime(kernel_folder(f"state-{nth}"), (nth, nth))
    kept = {path.name for path in (all_kernels() / "plugins").iterdir()}
    assert len(kept) == 9
    assert "state-9" in kept


# Kernels compiled beforehand ----------------------------------------------------------------------


@pytest.fixture
def own_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "kernels"))
    monkeypatch.syspath_prepend(str(WORKSHOP))
    return tmp_path / "kernels"


def test_what_was_compiled_beforehand_is_not_compiled_by_a_run(
    tmp_path: Path, own_kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = write_studio(tmp_path, "paint.kernel")
    assert all(shipped_workflow(name).is_file() and sets for name, sets in warm.RECIPES.items())
    monkeypatch.setattr(warm, "RECIPES", {str(studio): ("survey.offset_m=2",)})
    warmed = json.loads(asked("warm", "--json", code=0).stdout)
    assert warmed["methods"] == ["paint.kernel", "survey.offset"]
    assert (warmed["n_compiled"], warmed["n_before"], warmed["failed"]) == (2, 0, {})
    assert warmed["folder"] == str(own_kernels)
    before = _files(own_kernels)
    environment = {VARIABLE: str(own_kernels)}
    orthoflow(tmp_path, "run", "studio.yaml", "-o", "run", environment=environment, code=0)
    assert _files(own_kernels) == before
    assert _files(tmp_path / ".orthoflow") == {}


def test_the_conformance_suite_shares_the_kernels_of_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with plugins.sharing_kernels("paint.kernel"):
        folder = Path(os.environ[VARIABLE])
    assert folder.is_relative_to(tmp_path / "orthoflow" / "numba")
    assert VARIABLE not in os.environ
