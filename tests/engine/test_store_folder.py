"""A store is made where nothing else lies, and nothing else is cleaned up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.engine.cleaning import check_store, collect_garbage
from orthoflow.engine.store import Store
from orthoflow.errors import ArgumentError


def use(store: Store) -> None:
    with store.in_use():
        pass


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """What looks like a store to who looks at `objects` alone."""
    folder = tmp_path / "place" / ".git"
    (folder / "objects" / "ab").mkdir(parents=True)
    (folder / "objects" / "ab" / "cd").write_bytes(b"precious")
    (folder / "HEAD").write_text("ref: refs/heads/main")
    return folder


@pytest.mark.parametrize("command", [use, collect_garbage, check_store])
def test_a_folder_of_something_else_is_refused_and_left_as_it_was(
    repository: Path, command: Callable[[Store], object]
) -> None:
    (repository / "results").mkdir()
    before = contents(repository)
    with pytest.raises(
        ArgumentError, match=r"\.git is not a store of orthoflow: it holds HEAD; name"
    ):
        command(Store(repository))
    assert contents(repository) == before
    (repository / "refs").mkdir()
    with pytest.raises(ArgumentError, match=r"it holds HEAD and 1 more;"):
        command(Store(repository))
