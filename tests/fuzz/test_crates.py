"""Whatever lies in a crate, and whatever it says of itself: it is only a folder with a record."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from tests.fuzz.harness import BUDGET_S, SEED
from tests.fuzz.hostile_files import TEXTS, changed_json, damage_bytes, damage_structure
from tests.fuzz.test_records import MOST_CASES, check_command, surroundings
from tests.studios import Studio, open_studio

COMMANDS = (
    ("verify",),
    ("show",),
    ("compare", "ORIGINAL"),
    ("export", "--to", "ro-crate", "-o", "out/crate"),
    ("export", "--to", "ro-crate", "--embed", "-o", "out/embedded"),
    ("replay", "-o", "out/again"),
)
SECRET = "what lies outside"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A crate called `first`, in a folder whose surroundings are watched."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("crates") / "a" / "b"
        folder.mkdir(parents=True)
        (folder / "secret.txt").write_text(SECRET)
        studio = open_studio(folder, patch)
        (folder / "n.txt").write_text("1.5")
        studio.run("run", "--input", "number=n.txt", "--embed")
        done = studio("export", "run", "--to", "ro-crate", "-o", "first")
        assert done.exit_code == 0, done.output
        yield studio


def damage_crate(crate: Path, random: Random) -> None:
    """Change what it says, exchange files for links and pipes, or damage its record."""
    files = sorted(path for path in crate.rglob("*") if path.is_file() and path.name != "run.h5")
    for _ in range(random.choice((1, 2, 4))):
        path, kind = random.choice(files), random.randrange(8)
        if kind == 0:
            damage_structure(crate / "run.h5", random)
        elif kind == 1:
            damage_bytes(crate / "run.h5", random)
        elif kind == 2:
            metadata = crate / "ro-crate-metadata.json"
            if (
                metadata.is_file()
                and not metadata.is_symlink()
                and metadata.stat().st_size < 1 << 20
            ):
                metadata.write_text(changed_json(metadata.read_bytes(), random))
        elif kind == 3 and path.is_file() and not path.is_symlink():
            os.truncate(path, random.choice((0, 1, 1 << 40)))
        elif kind == 4:
            name = random.choice([text for text in TEXTS if text and "/" not in text])
            _put_link(path.parent / name[:200], random)
        else:
            path.unlink(missing_ok=True)
            if kind == 5:
                os.mkfifo(path)
            else:
                _put_link(path, random)


def _put_link(path: Path, random: Random) -> None:
    if not os.path.lexists(path):
        targets = ("/dev/zero", "../../../../secret.txt", "../../../..", str(path), "/dev/tty")
        path.symlink_to(random.choice(targets))


def test_a_damaged_crate_gets_a_sentence_and_nothing_outside_gets_into_another(
    finished: Studio,
) -> None:
    folder = finished.folder
    crate, out = folder / "out" / "run", folder / "out"
    before = surroundings(folder)
    deadline = time.process_time() + BUDGET_S
    number = 0
    while number < MOST_CASES and (time.process_time() < deadline or number == 0):
        random = Random(f"{SEED} {number}")
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(folder / "first", crate)
        damage_crate(crate, random)
        for command in (("verify",), random.choice(COMMANDS)):
            check_command(finished, command, crate, f"seed {SEED}, case {number}")
        for made in (out / "crate", out / "embedded"):
            for path in made.rglob("*"):
                assert not path.is_symlink()
                assert not path.is_file() or SECRET.encode() not in path.read_bytes()
            if (made / "ro-crate-metadata.json").is_file():
                assert json.loads((made / "ro-crate-metadata.json").read_text())["@graph"]
        number += 1
    after = surroundings(folder)
    changed = {path for path in before | after if before.get(path) != after.get(path)}
    assert {path for path in changed if not path.is_relative_to(folder / ".orthoflow")} == set()
