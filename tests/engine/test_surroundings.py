"""Runs where a machine is not as a desk has it: no home, odd folders, few files, a clock gone back.

Root may write everywhere; where a test is about rights, it gives these up for the command.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from orthoflow.records.open import open_run
from orthoflow.records.verify import verify_run
from tests.engine_world import install_toys, toy_world
from tests.forked_commands import run_command
from tests.killed_runs import ROOT, run_here
from tests.optional import skip_unless
from tests.stored_runs import WORKFLOW

IN_THIS_PROCESS = ("--executor", "inline")
NOBODY = 65534
_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_CAPBSET_DROP = 24
_CLONE_NEWNS, _MS_REC, _MS_PRIVATE = 0x20000, 0x4000, 0x40000
_RIGHTS_OF_ROOT = (1, 2, 3)  # to write, to read and to change what belongs to others
ENDED_WELL = "ended well"
# Runs commands one after the other, given as lists of words in JSON, until one fails.
ONE_BY_ONE = f"""
import json, sys
from orthoflow.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["orthoflow", *words]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
    print({ENDED_WELL!r}, file=sys.stderr)
"""


@dataclass(frozen=True)
class Desk:
    """A folder with a workflow of toys, in which commands run as processes of their own."""

    folder: Path

    def __call__(self, *arguments: str) -> tuple[int, str]:
        """Run a command as a user without the rights of root; exit code, and what it said."""
        done = run_command(self.folder, arguments, self.variables, forgone=_RIGHTS_OF_ROOT)
        return done.returncode, done.stderr

    @property
    def variables(self) -> dict[str, str]:
        parts = (ROOT, ROOT / "plugins", ROOT / "provenance", self.folder / "site")
        return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, parts))}


def desk_in(folder: Path) -> Desk:
    folder.mkdir(parents=True)
    install_toys(folder / "site")
    (folder / "toy.yaml").write_text(WORKFLOW)
    (folder / "numbers.txt").write_text("3 1 4 1 5")
    return Desk(folder)


@pytest.fixture
def used_desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    """A desk with a finished run `run`, made in this process, which has everything loaded."""
    desk = desk_in(tmp_path / "desk")
    monkeypatch.chdir(desk.folder)
    with toy_world(desk.folder):
        assert run_here(("run", "toy.yaml", "-o", "run", *IN_THIS_PROCESS)) == 0
    return desk


def check_finished(desk: Desk, name: str = "run") -> None:
    assert verify_run(desk.folder / name).findings == ()
    assert {cell.status for cell in open_run(desk.folder / name).cells.values()} == {"ok"}


def check_sentence(said: str, part: str) -> None:
    assert "Traceback" not in said
    assert "orthoflow itself failed" not in said
    assert "error: " in said or "failed: " in said
    assert part in said


# Homes and folders --------------------------------------------------------------------------------


def test_neither_home_nor_proc_is_needed_and_a_folder_may_have_any_name(tmp_path: Path) -> None:
    name = 'Стена «"Восток"», d\'été $HOME `x` %s {0} [1] *'
    desk = desk_in(tmp_path / name / name / name / name)
    assert len(str(desk.folder)) > 200
    place = desk.folder / "home"
    place.mkdir(mode=0o500)
    changed = ("HOME", "MPLCONFIGDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "NUMBA_CACHE_DIR")
    variables = {name: value for name, value in desk.variables.items() if name not in changed}
    # One new interpreter for all: what loads in such a home is the same for each command.
    numbers = f"numbers={desk.folder / 'numbers.txt'}"
    commands = (
        ["run", "toy.yaml", "-o", "run"],
        ["report", "run"],
        ["export", "run", "--to", "ro-crate", "-o", "crate"],
        ["replay", "crate", "-o", "again", *IN_THIS_PROCESS, "--input", numbers],
    )

    def forgo_rights() -> None:
        # Where it is allowed, hide /proc from the command and all that it starts.
        private = _MS_REC | _MS_PRIVATE
        if not (_LIBC.unshare(_CLONE_NEWNS) or _LIBC.mount(None, b"/", None, private, None)):
            _LIBC.mount(b"none", b"/proc", b"tmpfs", 0, None)
        for capability in _RIGHTS_OF_ROOT:
            _LIBC.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)

    done = subprocess.run(
        [sys.executable, "-c", ONE_BY_ONE, json.dumps(commands)],
        cwd=desk.folder,
        env={**variables, "HOME": str(place)},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        preexec_fn=forgo_rights,
    )
    assert (done.returncode, done.stderr.count(ENDED_WELL)) == (0, len(commands)), done.stderr
    assert "Traceback" not in done.stderr
    check_finished(desk)
    check_finished(desk, "again")
    assert list(place.iterdir()) == []


# Rights -------------------------------------------------------------------------------------------


def read_only(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(path.stat().st_mode & ~0o222)


def test_what_may_only_be_read_is_read_and_nothing_else(used_desk: Desk) -> None:
    desk = used_desk
    read_only(desk.folder)
    for command in (("verify", "run"), ("plan", "toy.yaml")):
        code, said = desk(*command)
        assert code == 0, said
    run = ("run", "toy.yaml", "-o", "second", *IN_THIS_PROCESS)
    for command in (run, ("export", "run", "--to", "ro-crate", "-o", "crate"), ("cache", "gc")):
        code, said = desk(*command)
        # 2: where an export goes is an argument.
        assert code in (1, 2), (command, said)
        check_sentence(said, "ermission")
    check_finished(desk)


@skip_unless(os.geteuid() == 0, "right", "only root can give files away")
@pytest.mark.parametrize("is_open", [False, True], ids=["theirs", "shared"])
def test_the_store_of_another_user_serves_as_far_as_it_may_be_written(
    used_desk: Desk, *, is_open: bool
) -> None:
    desk = used_desk
    store = desk.folder / ".orthoflow"
    for path in (store, *store.rglob("*")):
        os.chown(path, NOBODY, NOBODY)
        path.chmod(0o777 if is_open else 0o755 if path.is_dir() else 0o644)
    code, said = desk("run", "toy.yaml", "-o", "second", *IN_THIS_PROCESS)
    if is_open:
        assert code == 0, said
        assert all(cell.cached_from for cell in open_run(desk.folder / "second").cells.values())
        check_finished(desk, "second")
    else:
        assert code == 1, said
        check_sentence(said, "Permission denied; fix this, or choose")
    assert desk("cache", "gc")[0] == (0 if is_open else 1)


# Clocks -------------------------------------------------------------------------------------------


def test_a_clock_that_goes_back_changes_dates_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every look at the clock gives a time a year before the last one."""
    looks = iter(range(1_000))

    class Clock(datetime):
        @classmethod
        def now(cls, tz: object = None) -> datetime:  # type: ignore[override]
            return datetime(2026, 11, 23, tzinfo=UTC) - timedelta(days=365 * next(looks))

    monkeypatch.setattr("orthoflow.engine.environment.datetime", Clock)
    desk = desk_in(tmp_path / "desk")
    monkeypatch.chdir(desk.folder)
    with toy_world(desk.folder):
        for name in ("first", "second"):
            assert run_here(("run", "toy.yaml", "-o", name, *IN_THIS_PROCESS)) == 0
            check_finished(desk, name)
        for command in (("verify", "second"), ("show", "second"), ("compare", "first", "second")):
            assert run_here(command) == 0
    assert all(cell.cached_from for cell in open_run(desk.folder / "second").cells.values())
    assert next(looks) > 4
