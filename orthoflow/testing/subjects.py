"""A method to be checked, with its runs, each of which is executed at most once."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.engine.kernels import VARIABLE
from orthoflow.engine.store import digest_of
from orthoflow.products import Planes, Product
from orthoflow.sdk import Method, port_specs
from orthoflow.testing.examples import example_inputs, example_room
from orthoflow.testing.trials import Trial, TrialRun, run_trial

_Product = TypeVar("_Product", bound=Product)

_LIMIT_S: Final = 600
# The smallest surface of a room has 2,300 points, which determine its direction to 0.003 deg.
_ROOM_POINTS: Final = 20_000
# Seeds of rooms, and the angles by which they are rotated about the vertical in degrees.
_ROOMS: Final = ((2, 0.0), (3, 33.0), (4, 191.7))
_PROGRAM: Final = """
import json, pickle, sys
from pathlib import Path
from orthoflow.testing.trials import run_trial
world = Path(sys.argv[1])
run = run_trial(pickle.loads((world / "trial").read_bytes()), world / "scratch", draws=False)
(world / "digests.json").write_text(json.dumps(dict(run.digests)))
"""


class Subject:
    """A method to be checked, and its runs, which the checks compare.

    Args:
        trial: a trial with one core.
        golden: file with golden results, or None.
    """

    def __init__(self, trial: Trial, golden: Path | None = None) -> None:
        self.trial = trial
        self.golden = golden
        self.changed_inputs: list[str] = []  # ports whose input the first run changed

    @property
    def method(self) -> type[Method]:
        """Class of the method."""
        return self.trial.method

    @cached_property
    def first(self) -> TrialRun:
        """The first run, on a copy of the inputs, so that later runs have unchanged inputs."""
        given = {k: one for k, one in self.trial.inputs.items() if isinstance(one, Product)}
        copies = deepcopy(given)
        run = _run(replace(self.trial, inputs={**self.trial.inputs, **copies}))
        self.changed_inputs += [k for k in given if digest_of(copies[k]) != digest_of(given[k])]
        return run

    @cached_property
    def again(self) -> TrialRun:
        """A second run in the same process, on two cores if the results are then the same."""
        if self.on_two_cores.digests == self.first.digests:
            return self.on_two_cores
        return _run(self.trial)

    @cached_property
    def on_two_cores(self) -> TrialRun:
        """The same run on two cores."""
        return _run(replace(self.trial, cores=2))

    @cached_property
    def elsewhere(self) -> tuple[Mapping[str, str], list[str]]:
        """Digests of the same run in a new process with another hash seed, and files left behind.

        Files left behind are those in the working, home and temporary folders of the process, all
        of which were empty before the run.

        Raises:
            AssertionError: the process failed; the message ends with the last line of its output.
        """
        with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
            return _run_elsewhere(self.trial, Path(folder))

    def run_on(self, **inputs: Product) -> TrialRun:
        """Run the method with other inputs on some ports."""
        return _run(replace(self.trial, inputs={**self.trial.inputs, **inputs}))

    @cached_property
    def turned_rooms(self) -> list[tuple[Planes, Planes]]:
        """The planes found in each of several rotated rooms, and the true ones."""
        return [self.planes_in_room(seed, angle_deg) for seed, angle_deg in _ROOMS]

    def planes_in_room(
        self, seed: int, turned_deg: float, shift_m: NDArray[np.float64] | None = None
    ) -> tuple[Planes, Planes]:
        """Return the planes found in a room (see `example_room`), and the true ones."""
        cloud, truth = example_room(
            seed=seed, n_points=_ROOM_POINTS, turned_deg=turned_deg, shift_m=shift_m
        )
        return output_of(self.run_on(cloud=cloud), "planes", Planes), truth

    def run_on_photographs(self, **inputs: Product) -> TrialRun:
        """Run the method on the photographs of the suite, with other inputs on some ports."""
        ports = port_specs(self.method.In)
        examples = example_inputs(self.method, besides=inputs)
        used = {port: one for port, one in inputs.items() if port in ports}
        if not used and all(self.trial.inputs.get(port) is one for port, one in examples.items()):
            return self.first
        return _run(replace(self.trial, inputs={**examples, **used}))

    def run_cancelled(self) -> TrialRun:
        """Run the method in a step that is cancelled before it starts."""
        return _run(self.trial, is_cancelled=True)


def _run(trial: Trial, *, is_cancelled: bool = False) -> TrialRun:
    # Outputs may be mapped from files in the scratch folder; they remain readable after it is
    # removed.
    with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
        return run_trial(trial, Path(folder), is_cancelled=is_cancelled)


def _run_elsewhere(trial: Trial, world: Path) -> tuple[Mapping[str, str], list[str]]:
    places = {name: world / name for name in ("cwd", "home", "tmp")}
    for place in places.values():
        place.mkdir()
    (world / "trial").write_bytes(pickle.dumps(trial))
    environment = {
        VARIABLE: str(world / "numba"),
        **os.environ,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "PYTHONHASHSEED": "random",
        "HOME": str(places["home"]),
        "TMPDIR": str(places["tmp"]),
        # Redirect matplotlib's font cache as the engine does, so that it does not count as a stray
        # file.
        "MPLCONFIGDIR": str(world / "matplotlib"),
        # Use two threads if this process uses one, otherwise one.
        "OPENBLAS_NUM_THREADS": "2" if os.environ.get("OPENBLAS_NUM_THREADS") == "1" else "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(world)],
        cwd=places["cwd"],
        env=environment,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=_LIMIT_S,
        check=False,
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise AssertionError(
            f"in a new process the method ended with exit code {done.returncode}: {last}"
        )
    found = [path for place in places.values() for path in sorted(place.rglob("*"))]
    strays = [str(path.relative_to(world)) for path in found if path.is_file()]
    return json.loads((world / "digests.json").read_text()), strays


def output_of(run: TrialRun, port: str, kind: type[_Product]) -> _Product:
    """Return an output that all methods of its kind must have.

    Raises:
        AssertionError: the output is missing or of another type.
    """
    product = run.outputs.get(port)
    if not isinstance(product, kind):
        raise AssertionError(f"output {port} is missing")  # noqa: TRY004 - a broken rule
    return product


def require(holds: object, sentence: str) -> None:
    """Raise an error with one sentence unless a condition is true.

    Raises:
        AssertionError: the condition is false.
    """
    if not holds:
        raise AssertionError(sentence)
