"""Content is identity: what would count twice is refused, whatever it is called."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.errors import InputError
from tests.engine_world import World

STEPS = """
inputs: {{data: {{files: [{files}]}}}}
steps:
  first: {{use: make.file, in: {{files: inputs.data}}}}
"""


def hard_link(path: Path, other: Path) -> None:
    os.link(path, other)


def symbolic_link(path: Path, other: Path) -> None:
    other.symlink_to(path)


@pytest.mark.parametrize("make", [shutil.copyfile, hard_link, symbolic_link])
def test_a_file_that_is_there_twice_is_refused(
    world: World, make: Callable[[Path, Path], object]
) -> None:
    (world.folder / "a.txt").write_text("1 2 3")
    make(world.folder / "a.txt", world.folder / "b.txt")
    with pytest.raises(InputError) as refused:
        world.plan(STEPS.format(files="a.txt, b.txt"))
    assert refused.value.exit_code == 2
    for name in ("a.txt", "b.txt", "first"):
        assert name in str(refused.value)


def test_one_file_under_several_spellings_counts_once(world: World) -> None:
    (world.folder / "a.txt").write_text("1 2 3")
    (world.folder / "b.txt").write_text("4 5 6")
    plan = world.plan(STEPS.format(files='a.txt, ./a.txt, "[ab].txt", b.txt'))
    given = plan.inputs["data"]
    assert given is not None
    assert [path.name for path in given.paths] == ["a.txt", "b.txt"]


@pytest.mark.parametrize("how", ["sidecar", "declared"])
def test_files_that_may_repeat_each_other_are_taken(world: World, how: str) -> None:
    suffix = "xmp" if how == "sidecar" else "txt"
    for name in "ab":
        (world.folder / f"{name}.{suffix}").write_text("1 2 3")
    if how == "declared":
        source = world.site / "toy_plugin" / "makes.py"
        id_line = '    id = "make.file"\n'
        text = source.read_text()
        assert id_line in text
        source.write_text(text.replace(id_line, f'{id_line}    repeatable = ("files",)\n'))
    assert world.plan(STEPS.format(files=f"a.{suffix}, b.{suffix}"))
