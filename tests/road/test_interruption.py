"""Killed at any moment, the same command goes on and ends with the digests of a quiet run."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

import orthoflow
from tests.road.conftest import Shell

RUN = (
    *("run", "direct.yaml", "--until", "wall"),
    *("--set", "room.scan_step_m=0.05", "--set", "wall.gsd_m=0.05"),
)
KILLS = 10
pytestmark = pytest.mark.long


def digests(run_folder: Path) -> dict[str, str]:
    run = orthoflow.open_run(run_folder)
    return {
        f"{address}.{port}": product.digest
        for address, cell in run.cells.items()
        for port, product in cell.outputs.items()
    }


@dataclass(frozen=True)
class Quiet:
    """A run that nobody disturbed: how long it took, and the digests of its products."""

    duration_s: float
    digests: dict[str, str]


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Quiet:
    shell = Shell(tmp_path_factory.mktemp("quiet"), store)
    started = time.monotonic()
    ended = shell(*RUN, "-o", "run", "--store", "store")
    assert ended.code == 0, ended.said
    return Quiet(time.monotonic() - started, digests(shell.folder / "run"))


def test_killed_runs_resume_with_the_same_digests(shell: Shell, quiet: Quiet) -> None:
    rng = random.Random(20150807)
    for attempt in range(KILLS):
        store = f"store{attempt}"
        arguments = (*RUN, "-o", f"killed{attempt}", "--store", store)
        _kill_after(shell, arguments, rng.uniform(0.5, quiet.duration_s))
        ended = shell(*arguments)
        finished_before = ended.code == 2 and "run.h5" in ended.said
        assert ended.code == 0 or finished_before, ended.said
        assert digests(shell.folder / f"killed{attempt}") == quiet.digests
        assert shell("verify", f"killed{attempt}").code == 0


def _kill_after(shell: Shell, arguments: tuple[str, ...], seconds: float) -> None:
    process = subprocess.Popen(
        shell.command(*arguments),
        cwd=shell.folder,
        env=shell.variables(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        stdin=subprocess.DEVNULL,
    )
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait()


def test_both_executors_give_the_same_digests(shell: Shell, quiet: Quiet) -> None:
    store = "store"
    ended = shell(*RUN, "-o", "run", "--store", store, "--executor", "inline")
    assert ended.code == 0, ended.said
    assert digests(shell.folder / "run") == quiet.digests
