"""Whatever is damaged in a store, no run takes it for good: it is computed again, and said."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from orthoflow.engine.cleaning import check_store
from orthoflow.engine.store import Store
from tests.long_loops import IS_LONG
from tests.stored_runs import StoredRuns, stored_runs

DAMAGES = 300 if IS_LONG else 7


# Kinds of damage ----------------------------------------------------------------------------------


def flip(path: Path, rng: random.Random) -> None:
    before, content = path.stat(), bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def truncate(path: Path, rng: random.Random) -> None:
    os.truncate(path, rng.randrange(path.stat().st_size))


def lengthen(path: Path, _: random.Random) -> None:
    with path.open("ab") as stream:
        stream.write(bytes(512))


def remove(path: Path, _: random.Random) -> None:
    path.unlink()


def make_a_folder_of_it(path: Path, _: random.Random) -> None:
    path.unlink()
    path.mkdir()


def link_elsewhere(path: Path, rng: random.Random) -> None:
    elsewhere = path.parents[2] / "elsewhere"
    shutil.copy(path, elsewhere)
    flip(elsewhere, rng)
    path.unlink()
    path.symlink_to(elsewhere)


def swap_with_another(path: Path, rng: random.Random) -> None:
    store = next(folder for folder in path.parents if folder.suffix == ".store")
    like = [p for p in store.rglob(f"*{path.suffix}") if p.is_file() and p != path]
    other = rng.choice(sorted(like) or [store / "digests.json"])
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)


KINDS: tuple[Callable[[Path, random.Random], None], ...] = (
    *(flip, truncate, lengthen, remove, make_a_folder_of_it, link_elsewhere, swap_with_another),
)
CLASSES = {
    "product": "objects/*/product.h5",
    "description": "objects/*/object.json",
    "published file": "objects/*/files/*",
    "figure": "objects/*/blob",
    "result": "results/*.json",
    "memory of digests": "digests.json",
    "lock": "lock",
}


@pytest.mark.longer
def test_no_damage_of_a_store_is_sealed_as_good(tmp_path: Path) -> None:
    with stored_runs(tmp_path) as laboratory:
        check_damages(laboratory)


def check_damages(laboratory: StoredRuns) -> None:
    rng = random.Random(20150808)
    expected = laboratory.sealed("quiet")
    quiet = laboratory.run("sound", "again")
    assert (quiet.code, "damaged" in quiet.said) == (0, False)
    n_said = 0
    for number in range(DAMAGES):
        name = f"damage{number}"
        store = laboratory.copy_store(name)
        kind = list(CLASSES)[number % len(CLASSES)]
        files = sorted(path for path in store.glob(CLASSES[kind]) if path.stat().st_size)
        path = rng.choice(files or [store / "digests.json"])
        harm = rng.choice(KINDS)
        if harm is make_a_folder_of_it and kind == "result":
            harm = truncate
        harm(path, rng)
        what = f"{harm.__name__} of {path.relative_to(store)}"
        answer = laboratory.run(name, name)
        assert answer.code == 0, f"{what}: {answer.said}"
        assert laboratory.sealed(name) == expected, what
        n_said += "damaged" in answer.said
        # What no run needed, such as a scan that nothing reads any more, is found by looking.
        check_store(Store(store))
        assert check_store(Store(store)).damaged == (), what
        shutil.rmtree(store)
        shutil.rmtree(laboratory.folder / name)
    assert n_said > DAMAGES / 3
