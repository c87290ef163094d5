"""Input files: content is identity, and what changes while a run reads it is noticed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.journal import CellStarted, RunEvent
from orthoflow.engine.scheduler import execute
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError, InputError
from tests.engine_world import World

STEPS = """
inputs: {data: {files: [FILES]}}
steps: {first: {use: make.file, in: {files: inputs.data}}}
"""


def rewrite_in_secret(path: Path) -> None:
    """Change the content, and nothing of what one usually looks at."""
    before = path.stat()
    path.write_text("3 2 1")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def exchange(path: Path) -> None:
    other = path.with_name("other.txt")
    other.write_text("3 2 1")
    shutil.copystat(path, other)
    other.replace(path)


def touch(path: Path) -> None:
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("change", [touch, rewrite_in_secret, exchange])
def test_an_input_that_changes_while_it_is_read_fails_its_step(
    world: World, change: Callable[[Path], object]
) -> None:
    path = world.folder / "a.txt"
    path.write_text("1 2 3")
    steps = STEPS.replace("FILES", "a.txt")

    def listen(event: RunEvent) -> None:
        if isinstance(event, CellStarted):
            change(path)

    plan = world.plan(steps, executor="inline")
    result = execute(plan, world.folder / "run", world.store, listen).results["first"]
    if change is touch:
        assert (result.status, result.error_message) == ("ok", "")
        return
    assert result.error_message == f"the input file {path} changed while it was read; run again"
    outcome = world.run(steps, into="again", executor="inline")
    assert (outcome.status, outcome.cached) == ("ok", {})


def test_what_no_run_can_read_twice_or_record_is_refused_before_anything_runs(
    world: World,
) -> None:
    os.mkfifo(world.folder / "a.txt")
    with pytest.raises(InputError, match=r"a\.txt must be a regular file, because"):
        world.plan(STEPS.replace("FILES", "a.txt"))
    odd = Path(os.fsdecode(os.fsencode(world.folder) + b"/\xff\xfe"))
    plan = world.plan("steps: {a: {use: make.range}}")
    with pytest.raises(ArgumentError, match=r"^the run folder .*\\udcff.* is not UTF-8: rename it"):
        execute(plan, odd / "run", world.store)
    with pytest.raises(ArgumentError, match=r"^the store .*\\udcff.* is not UTF-8: rename it"):
        execute(plan, world.folder / "run", Store(odd))
    assert not odd.exists()
    odd.mkdir()
    (odd / "numbers.txt").write_text("1")
    with pytest.raises(InputError, match=r"^the input file .*\\udcff.* is not UTF-8: rename it"):
        world.store.file_digests().digest(odd / "numbers.txt")
    for name in ("aux.laz", "a\nb.laz", "hall.", "c:hall.laz"):
        (world.folder / name).write_text("points")
        with pytest.raises(InputError, match=r"which some systems do not allow: rename it"):
            world.store.file_digests().digest(world.folder / name)


def settled_file(path: Path, content: str) -> Path:
    path.write_text(content)
    os.utime(path, (1e9, 1e9))
    return path


def test_digests_and_last_paths_of_files_are_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memo = tmp_path / "digests.json"
    digests = FileDigests(memo)
    first = settled_file(tmp_path / "scan.xyz", "1 2 3\n")
    second = settled_file(tmp_path / "copy.xyz", "1 2 3\n")
    sha256 = digests.digest(first).sha256
    assert digests.place(sha256) is None
    for path in (first, second):
        digests.note_place(sha256, path)
        digests.save()
        assert FileDigests(memo).place(sha256) == path

    def read(path: Path) -> str:
        path.write_text("while it is read")
        return "0" * 64

    monkeypatch.setattr("orthoflow.engine.file_digests.file_sha256", read)
    assert FileDigests(memo).digest(first).sha256 == sha256
    with pytest.raises(InputError, match=r"copy\.xyz changed while it was read; run again"):
        FileDigests(memo).digest(second)


@pytest.mark.parametrize("link", [shutil.copyfile, os.link, os.symlink])
def test_a_file_that_is_there_twice_is_refused(
    world: World, link: Callable[[Path, Path], object]
) -> None:
    (world.folder / "a.txt").write_text("1 2 3")
    link(world.folder / "a.txt", world.folder / "b.txt")
    with pytest.raises(
        InputError,
        match=r"a\.txt and .*b\.txt, which step first reads on port files, have the same",
    ):
        world.plan(STEPS.replace("FILES", "a.txt, b.txt"))
    # Under several spellings one file counts once.
    given = world.plan(STEPS.replace("FILES", 'a.txt, ./a.txt, "[a].txt"')).inputs["data"]
    assert given is not None
    assert [path.name for path in given.paths] == ["a.txt"]


@pytest.mark.parametrize("how", ["sidecar", "declared"])
def test_files_that_may_repeat_each_other_are_taken(world: World, how: str) -> None:
    suffix = "xmp" if how == "sidecar" else "txt"
    for name in "ab":
        (world.folder / f"{name}.{suffix}").write_text("1 2 3")
    if how == "declared":
        source = world.site / "toy_plugin" / "makes.py"
        id_line = '    id = "make.file"\n'
        source.write_text(
            source.read_text().replace(id_line, f'{id_line}    repeatable = ("files",)\n')
        )
    assert world.plan(STEPS.replace("FILES", f"a.{suffix}, b.{suffix}"))
