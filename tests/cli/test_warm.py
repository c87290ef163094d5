"""Kernels compiled beforehand: every store begins with them, and nothing hangs on them."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from orthoflow.cli import plugins, warm
from orthoflow.cli.program import program
from orthoflow.engine.compiled_code import VARIABLE, begun_with_warm, leave_for_others, warm_folder
from orthoflow.engine.executors import COMPILED_CODE
from tests.workshop_runs import WORKSHOP, orthoflow, write_studio


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where warm kernels go in a test."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def compiled(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*.nbc")}


def test_a_store_begins_with_what_was_compiled_beforehand(
    tmp_path: Path, kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    studio = write_studio(tmp_path, "paint.kernel")
    monkeypatch.setattr(warm, "_recipes", lambda: {studio: ("survey.offset_m=2",)})
    called = CliRunner().invoke(program, ["warm", "--json"])
    assert called.exit_code == 0, called.output
    told = json.loads(called.stdout)
    assert told["methods"] == ["paint.kernel", "survey.offset"]
    assert (told["n_compiled"], told["n_before"], told["failed"]) == (2, 0, {})
    assert told["folder"] == str(kernels)
    again = CliRunner().invoke(program, ["warm", str(studio)])
    assert again.stdout.splitlines()[0].startswith("compiled 0 kernels of 2 methods in ")
    assert again.stdout.splitlines()[0].endswith(", 2 were there")
    begins = {VARIABLE: str(kernels)}
    done = orthoflow(tmp_path, "run", "studio.yaml", "-o", "run", environment=begins)
    assert done.returncode == 0, done.stderr
    (store,) = (tmp_path / ".orthoflow" / "numba").iterdir()
    assert compiled(store) == compiled(kernels)
    assert len(compiled(store)) == 2
    began = {path.name: path.read_bytes() for path in kernels.rglob("*.nbi")}
    # An index that had got another kernel would differ.
    assert {path.name: path.read_bytes() for path in store.rglob("*.nbi")} == began


def test_shipped_workflows_are_tried_with_what_makes_them_small() -> None:
    recipes = warm._recipes()
    assert {path.stem for path in recipes} >= {"direct", "quickstart", "plane-methods"}
    assert all(path.is_file() and sets for path, sets in recipes.items())


def test_where_nothing_is_to_be_compiled_nothing_runs(tmp_path: Path) -> None:
    nothing: Any = SimpleNamespace(cells=())
    assert warm._executed(nothing, tmp_path / "run", nothing) == []
    assert not (tmp_path / "run").exists()


def test_a_folder_of_kernels_is_copied_once_and_only_where_there_is_none(
    tmp_path: Path, kernels: Path
) -> None:
    (kernels / "abc" / "plane_1").mkdir(parents=True)
    (kernels / "abc" / "plane_1" / "f.nbc").write_bytes(b"code")
    folder = tmp_path / "store" / "numba" / "abc"
    assert begun_with_warm(folder) == folder
    assert (folder / "plane_1" / "f.nbc").read_bytes() == b"code"
    assert [path.name for path in folder.parent.iterdir()] == ["abc"]
    (kernels / "abc" / "plane_1" / "g.nbc").write_bytes(b"more")
    begun_with_warm(folder)
    assert not (folder / "plane_1" / "g.nbc").exists()
    assert not begun_with_warm(folder.with_name("def")).exists()


def test_a_new_state_of_the_code_begins_with_the_youngest_kernels_of_the_one_before(
    tmp_path: Path, kernels: Path
) -> None:
    for nth, state in enumerate(("older", "before")):
        (kernels / state / "plane_1").mkdir(parents=True)
        (kernels / state / "plane.x.foretold").touch()
        os.utime(kernels / state, ns=(nth, nth))
    names = ("f.checked-1.nbi", "f.checked-1.ab.nbc", "f.checked-2.nbi", "f.checked-2.cd.nbc")
    for nth, name in enumerate((*names, "strangers.1.nbc", "strangers.nbi")):
        (kernels / "before" / "plane_1" / name).write_bytes(name.encode())
        os.utime(kernels / "before" / "plane_1" / name, ns=(nth, nth))
        os.utime(kernels / "before", ns=(9, 9))
    folder = begun_with_warm(tmp_path / "store" / "numba" / "new")
    # Nor what says that all kernels of a method are there.
    found = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert found == {name: name.encode() for name in names[2:]}
    leave_for_others(folder, 1)
    assert {path.name for path in (kernels / "new" / "plane_1").iterdir()} == set(found)


def test_kernels_that_cannot_be_copied_are_compiled_instead(tmp_path: Path, kernels: Path) -> None:
    (kernels / "abc").mkdir(parents=True)
    (kernels / "abc" / "f.nbc").write_bytes(b"code")
    (tmp_path / "store").touch()
    folder = tmp_path / "store" / "numba" / "abc"
    assert begun_with_warm(folder) == folder
    assert (tmp_path / "store").read_bytes() == b""


@pytest.mark.parametrize(("free_bytes", "is_copied"), [(499_000_000, False), (501_000_000, True)])
def test_kernels_leave_a_disk_with_little_room_to_the_run(
    tmp_path: Path,
    kernels: Path,
    monkeypatch: pytest.MonkeyPatch,
    free_bytes: int,
    is_copied: bool,
) -> None:
    (kernels / "abc").mkdir(parents=True)
    (kernels / "abc" / "f.nbc").write_bytes(b"code")
    usage = SimpleNamespace(free=free_bytes)
    monkeypatch.setattr(shutil, "disk_usage", {tmp_path: usage}.__getitem__)
    assert begun_with_warm(tmp_path / "store" / "numba" / "abc").exists() == is_copied


def test_what_a_run_compiles_every_later_store_begins_with(tmp_path: Path, kernels: Path) -> None:
    folder = tmp_path / "store" / "numba" / "abc"
    (folder / "plane_1").mkdir(parents=True)
    for name in ("f.checked.nbi", "f.checked.1a.nbc", "strangers.1.nbc", "old.checked.2b.nbc"):
        (folder / "plane_1" / name).write_bytes(name.encode())
    os.utime(folder / "plane_1" / "old.checked.2b.nbc", ns=(0, 0))
    leave_for_others(folder, 1)
    found = {path.name: path.read_bytes() for path in (kernels / "abc" / "plane_1").iterdir()}
    assert found == {name: name.encode() for name in ("f.checked.nbi", "f.checked.1a.nbc")}
    other = begun_with_warm(tmp_path / "other" / "numba" / "abc")
    assert sorted(path.name for path in other.rglob("*.nb?")) == sorted(found)


def test_what_a_store_began_with_is_not_left_once_more(tmp_path: Path, kernels: Path) -> None:
    (kernels / "abc" / "plane_1").mkdir(parents=True)
    names = ("f.checked.nbi", "f.checked.1a.nbc", "plane.x.foretold")
    for name in names:
        (kernels / "abc" / "plane_1" / name).write_bytes(b"here")
    began = {path: path.stat().st_ino for path in kernels.rglob("*")}
    folder = begun_with_warm(tmp_path / "store" / "numba" / "abc")
    leave_for_others(folder, 0)
    assert {path: path.stat().st_ino for path in kernels.rglob("*")} == began
    # One that was damaged is compiled anew.
    time.sleep(0.05)
    (folder / "plane_1" / names[1]).write_bytes(b"anew")
    leave_for_others(folder, 0)
    assert (kernels / "abc" / "plane_1" / names[1]).read_bytes() == b"anew"
    assert (kernels / "abc" / "plane_1" / names[0]).stat().st_ino in began.values()


def test_the_conformance_suite_begins_with_kernels_of_runs_and_leaves_its_own(
    kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    monkeypatch.delenv(COMPILED_CODE)
    with plugins._sharing_kernels("paint.kernel"):
        folder = Path(os.environ[COMPILED_CODE])
        folder.mkdir(parents=True)
        (folder / "f.checked.1a.nbc").write_bytes(b"code")
    assert not folder.exists()
    assert COMPILED_CODE not in os.environ
    assert compiled(kernels) == {"f.checked.1a.nbc"}
    with plugins._sharing_kernels("paint.kernel"):
        assert compiled(Path(os.environ[COMPILED_CODE])) == {"f.checked.1a.nbc"}


def test_kernels_that_cannot_be_left_are_kept_by_their_store_alone(
    tmp_path: Path, kernels: Path
) -> None:
    folder = tmp_path / "store" / "numba" / "abc"
    folder.mkdir(parents=True)
    (folder / "f.checked.nbi").write_bytes(b"code")
    kernels.parent.mkdir(parents=True, exist_ok=True)
    kernels.write_bytes(b"a file stands here")
    leave_for_others(folder, 0)
    assert kernels.read_bytes() == b"a file stands here"


def test_a_folder_that_cannot_be_written_is_one_sentence_with_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file" / "kernels"))
    called = CliRunner().invoke(program, ["warm"])
    assert called.exit_code == 1
    assert "cannot write to" in called.stderr
    assert f"; name one with the variable {VARIABLE}" in called.stderr


def test_without_a_name_kernels_are_in_the_users_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert warm_folder() == tmp_path / "orthoflow" / "kernels"


def test_methods_that_no_recipe_tries_are_named(
    tmp_path: Path, kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(WORKSHOP))
    monkeypatch.setattr(warm, "_recipes", dict)
    called = CliRunner().invoke(program, ["warm", str(write_studio(tmp_path))])
    assert called.exit_code == 0
    assert called.stdout.splitlines()[:2] == [
        "paint.plain: no simulated room tries it: it compiles when it first runs",
        "survey.offset: no simulated room tries it: it compiles when it first runs",
    ]
