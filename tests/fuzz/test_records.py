"""Whatever a record holds, every command ends with one sentence and writes where it was told to."""

from __future__ import annotations

import resource
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from tests.fuzz.harness import BUDGET_S, N_CASES, SEED
from tests.fuzz.hostile_files import damage_bytes, damage_structure
from tests.studios import Studio, open_studio

# A case is a command or two, and takes as long as thirty files.
MOST_CASES = N_CASES // 6 or 1_000_000
MOST_CPU_S = 5.0
MOST_MEMORY_KIB = 1536 << 10
COMMANDS = (
    ("show",),
    ("show", "--json"),
    ("compare", "ORIGINAL"),
    ("report", "-o", "out/report.html"),
    ("export", "--to", "csv", "-o", "out/csv"),
    ("export", "--to", "figures", "-o", "out/figures"),
    ("export", "--to", "ro-crate", "-o", "out/crate"),
    ("export", "--embed", "-o", "out/embedded"),
    ("replay", "-o", "out/again"),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A run with its input file in the record, in a folder whose surroundings are watched."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("records") / "a" / "b"
        folder.mkdir(parents=True)
        studio = open_studio(folder, patch)
        (folder / "n.txt").write_text("1.5")
        studio.run("first", "--input", "number=n.txt", "--embed")
        patch.undo()
        patch.syspath_prepend(str(Path(__file__).parents[1] / "workshop"))
        patch.chdir(folder)
        yield studio


def check_command(studio: Studio, command: tuple[str, ...], run: Path, case: str) -> None:
    """Run a command on a record and look at how it ends."""
    words = [str(studio.folder / "first") if word == "ORIGINAL" else word for word in command[1:]]
    before = time.process_time()
    done = studio(command[0], run, *words)
    took_s = time.process_time() - before
    told = f"{case}: {' '.join(command)}: {done.output[-2000:]}"
    if done.exception and not isinstance(done.exception, SystemExit):
        raise AssertionError(told) from done.exception
    # 4: a record may name methods that are not there.
    assert done.exit_code in ({0, 1, 2, 3, 4} if command[0] == "replay" else {0, 1, 2, 3}), told
    assert "itself failed" not in done.output, told
    assert "Traceback" not in done.output, told
    if done.exit_code and "--json" not in command:
        assert "error: " in done.stderr, told
    assert not {"\x1b", "\x9b", "\u202e"} & set(done.output), told
    assert took_s < MOST_CPU_S, f"{told}: {took_s} s"
    memory_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert memory_kib < MOST_MEMORY_KIB, f"{told}: {memory_kib} KiB"


def surroundings(folder: Path) -> dict[Path, int]:
    """Everything but the folder in which commands may write."""
    return {
        path: path.lstat().st_mtime_ns
        for top in (folder, folder.parents[1])
        for path in top.rglob("*")
        if not path.is_relative_to(folder / "out") and path.is_file()
    }


@pytest.mark.parametrize("damage", [damage_bytes, damage_structure])
def test_a_damaged_record_gets_a_sentence_and_nothing_is_written_elsewhere(
    finished: Studio, damage: Callable[[Path, Random], None]
) -> None:
    folder = finished.folder
    run, out = folder / "out" / "run", folder / "out"
    before = surroundings(folder)
    deadline = time.process_time() + BUDGET_S
    number = 0
    while number < MOST_CASES and (time.process_time() < deadline or number == 0):
        case = f"{damage.__name__}, seed {SEED}, case {number}"
        random = Random(f"{SEED} {number}")
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(folder / "first", run)
        damage(run / "run.h5", random)
        for command in (("verify",), random.choice(COMMANDS)):
            check_command(finished, command, run, case)
        number += 1
    after = surroundings(folder)
    # Digests of files are remembered there.
    assert {path for path in before | after if before.get(path) != after.get(path)} <= {
        folder / ".orthoflow" / "digests.json",
        *(path for path in after if path.is_relative_to(folder / ".orthoflow")),
    }
