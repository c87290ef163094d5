"""Runs of a method for checks, each made only once and only if needed."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np

from orthoflow.engine.store import digest_of
from orthoflow.products import Product
from orthoflow.sdk import Method
from orthoflow.testing.examples import example_inputs
from orthoflow.testing.isolation import ElsewhereRun, run_elsewhere
from orthoflow.testing.trials import Trial, TrialRun, run_trial

_Product = TypeVar("_Product", bound=Product)


@dataclass(frozen=True, kw_only=True)
class WatchedRun:
    """A run, and its side effects.

    Attributes:
        run: result of the run.
        changed_inputs: names of inputs whose digest has changed.
        drew_globally: whether the state of numpy's global generator has changed.
    """

    run: TrialRun
    changed_inputs: tuple[str, ...]
    drew_globally: bool


class Witness:
    """Runs a trial in the different ways that checks compare.

    Args:
        trial: a trial with one core.
    """

    def __init__(self, trial: Trial) -> None:
        self.trial = trial

    @cached_property
    def first(self) -> WatchedRun:
        """The first run, with its side effects."""
        inputs, state = deepcopy(dict(self.trial.inputs)), _global_state()
        before = _digests(inputs)
        run = _run(replace(self.trial, inputs=inputs))
        after = _digests(inputs)
        changed = tuple(name for name in before if before[name] != after[name])
        return WatchedRun(run=run, changed_inputs=changed, drew_globally=state != _global_state())

    @cached_property
    def again(self) -> TrialRun:
        """A second run in the same process; with two cores if that gave the same results."""
        if self.on_two_cores.digests == self.first.run.digests:
            return self.on_two_cores
        return _run(self.trial)

    @cached_property
    def on_two_cores(self) -> TrialRun:
        """The same run on two cores."""
        return _run(replace(self.trial, cores=2))

    @cached_property
    def elsewhere(self) -> ElsewhereRun:
        """The same run in a new process with empty folders."""
        with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
            return run_elsewhere(self.trial, Path(folder))


def _run(trial: Trial) -> TrialRun:
    # Outputs may be files mapped from the scratch folder; they stay readable after its removal.
    with TemporaryDirectory(prefix="orthoflow-conformance-") as folder:
        return run_trial(trial, Path(folder))


def _digests(inputs: Mapping[str, object]) -> dict[str, str]:
    return {name: digest_of(given) for name, given in inputs.items() if isinstance(given, Product)}


def _global_state() -> str:
    return repr(np.random.get_state())  # noqa: NPY002 - it is the global one that is watched


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A method to be checked, with its inputs.

    Attributes:
        witness: runs of the method on its inputs.
        folder: empty folder for further runs.
        golden: file with golden results, or None.
    """

    witness: Witness
    folder: Path
    golden: Path | None = None

    @property
    def method(self) -> type[Method]:
        """Class of the method."""
        return self.witness.trial.method

    def run_on(self, name: str, **inputs: Product) -> TrialRun:
        """Run the method with other inputs on some ports; `name` is used for the scratch folder."""
        trial = self.witness.trial
        changed = replace(trial, inputs={**trial.inputs, **inputs})
        return run_trial(changed, self.folder / name)

    def run_on_photographs(self, name: str = "photographs", **inputs: Product) -> TrialRun:
        """Run the method on the photographs of the suite, with other inputs on some ports."""
        examples = example_inputs(self.method)
        given = self.witness.trial.inputs
        if not inputs and all(given.get(port) is one for port, one in examples.items()):
            return self.witness.first.run
        changed = replace(self.witness.trial, inputs={**examples, **inputs})
        return run_trial(changed, self.folder / name)

    def run_cancelled(self) -> TrialRun:
        """Run the method in a step that is cancelled before it starts."""
        return run_trial(self.witness.trial, self.folder / "cancelled", is_cancelled=True)


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
