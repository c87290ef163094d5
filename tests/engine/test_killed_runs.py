"""Killed at any instant, a run goes on and ends with the same digests; no record is damaged."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from orthoflow.engine.store import Store
from orthoflow.records.open import open_run
from orthoflow.records.verify import verify_run
from tests.killed_runs import Answer, RunServer, run_server
from tests.long_loops import IS_LONG
from tests.workshop_runs import workshop_environment, write_studio

KILLS = 100 if IS_LONG else 4


@dataclass(frozen=True)
class Killer:
    """The server of runs, and a run that nobody disturbed."""

    server: RunServer

    @property
    def folder(self) -> Path:
        return self.server.folder

    def __call__(self, name: str, **order: object) -> Answer:
        """Run the workflow into a folder of that name, with a store of its own."""
        arguments = ["run", "studio.yaml", "-o", name, "--executor", "inline"]
        return self.server(*arguments, "--store", f"{name}.store", **order)

    def digests(self, name: str) -> dict[str, str]:
        run = open_run(self.folder / name)
        return {
            f"{address}.{port}": product.digest
            for address, cell in run.cells.items()
            for port, product in cell.outputs.items()
        }


@pytest.fixture(scope="module")
def killer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Killer]:
    folder = tmp_path_factory.mktemp("killed")
    write_studio(folder)
    with run_server(folder, workshop_environment()) as server:
        found = Killer(server)
        # The first run loads what runs need, so that forks begin with it.
        assert found("quiet", here=True).code == 0
        yield found


@pytest.mark.longer
def test_killed_runs_go_on_and_end_with_the_same_digests(killer: Killer) -> None:
    started = time.monotonic()
    watched = killer("watched")
    duration_s = time.monotonic() - started
    assert watched.code == 0
    assert watched.events > 500
    rng = random.Random(20150807)
    kills = resumed = 0
    while kills < KILLS:
        name = f"run{kills}"
        folder = killer.folder / name
        # Some runs are killed again while they go on.
        for _ in range(rng.choice((1, 1, 2, 3))):
            # At file operations, where it hurts, and at any time, also within HDF5's own writing.
            at_event = {"event": rng.randint(1, watched.events)}
            at_time = {"seconds": rng.uniform(0.0, duration_s)}
            code = killer(name, **(at_event if rng.random() < 0.6 else at_time)).code
            kills += 1
            assert code in (-9, 0, 2)  # 2: it had finished before
            if (folder / "run.h5").exists():
                assert verify_run(folder).findings == ()
                break
        was_finished = (folder / "run.h5").exists()
        assert killer(name).code == (2 if was_finished else 0)
        resumed += not was_finished
        assert verify_run(folder).findings == ()
        assert killer.digests(name) == killer.digests("quiet")
        scratch = Store(killer.folder / f"{name}.store").scratch
        assert [path for path in scratch.iterdir() if path.is_dir()] == []
        assert [path.name for path in folder.iterdir() if path.name[0] == "."] == []
    assert resumed > 0
