"""A store filled by a run of toys, and a server for more runs on copies of it."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from orthoflow.records.open import open_run
from orthoflow.records.verify import verify_run
from tests.engine_world import install_toys
from tests.killed_runs import Answer, RunServer, run_server

WORKFLOW = """
orthoflow: 1
name: toy
seed: 7
inputs:
  numbers: {files: numbers.txt}
steps:
  scan: {use: make.scan}
  read: {use: make.file, in: {files: inputs.numbers}}
  means: {use: thin.means, in: {scan: scan.scan}}
  noise: {use: work.noise, in: {numbers: means.numbers}}
  dots: {use: work.draws, in: {numbers: noise.numbers}}
  sum: {use: work.add, in: {numbers: read.numbers}}
"""


@dataclass(frozen=True)
class StoredRuns:
    """A sound store, the run `quiet` that filled it, and a server for more runs.

    Attributes:
        server: of runs.
        n_events: audit events of a run that computes everything.
        duration_s: how long it takes.
    """

    server: RunServer
    n_events: int
    duration_s: float

    @property
    def folder(self) -> Path:
        return self.server.folder

    @cached_property
    def expected(self) -> Mapping[str, object]:
        """What a record of this workflow says, with whatever harm its run has met."""
        return self.sealed("quiet")

    def copy_store(self, name: str) -> Path:
        """A copy of the sound store."""
        target = self.folder / f"{name}.store"
        shutil.copytree(self.folder / "sound.store", target)
        return target

    def run(self, name: str, into: str, *more: str, **order: object) -> Answer:
        arguments = ["run", "toy.yaml", "-o", into, "--executor", "inline"]
        return self.server(*arguments, "--store", f"{name}.store", *more, **order)

    def sealed(self, name: str) -> Mapping[str, object]:
        """What a run's record says of its content, which no damage may change."""
        run = open_run(self.folder / name)
        assert verify_run(self.folder / name).findings == ()
        return {
            "outputs": {
                f"{address}.{port}": output.digest
                for address, cell in run.cells.items()
                for port, output in cell.outputs.items()
            },
            "inputs": {entry.name: entry.files for entry in run.record.inputs},
            "figures": {a: cell.figures for a, cell in run.cells.items()},
            "metrics": {a: cell.metrics for a, cell in run.cells.items()},
            # Tables of metrics tell how long a cell took, each time anew.
            "published": {
                (file.path, file.sha256)
                for file in run.record.published
                if not file.path.endswith("metrics.csv")
            },
        }


@contextmanager
def stored_runs(folder: Path, workflow: str = WORKFLOW) -> Iterator[StoredRuns]:
    """Install the toys in a folder and fill a store."""
    install_toys(folder / "site")
    (folder / "toy.yaml").write_text(workflow)
    numbers = folder / "numbers.txt"
    numbers.write_text("3 1 4 1 5")
    os.utime(numbers, (1e9, 1e9))  # settled, so that its digest is remembered
    with run_server(folder, {**os.environ, "PYTHONPATH": str(folder / "site")}) as server:
        first = StoredRuns(server, 0, 0.0)
        answer = first.run("sound", "quiet", here=True)
        assert answer.code == 0, answer.said
        started = time.monotonic()
        watched = first.run("watched", "watched")
        yield StoredRuns(server, watched.events, time.monotonic() - started)
