"""What a check gets: the method, its runs, and a place to run it on something else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from orthoflow.products import Product
from orthoflow.sdk import Method
from orthoflow.testing.examples import example_inputs
from orthoflow.testing.trials import TrialRun, run_trial
from orthoflow.testing.witnesses import Witness


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A method with what to try it on.

    Attributes:
        witness: runs of the method on its inputs.
        folder: empty, for further runs.
        golden: file of digests that results are held to, or None.
    """

    witness: Witness
    folder: Path
    golden: Path | None = None

    @property
    def method(self) -> type[Method]:
        """The class."""
        return self.witness.trial.method

    def run_on(self, name: str, **inputs: Product) -> TrialRun:
        """Run the method with other inputs on some ports, in a scratch folder of that name."""
        trial = self.witness.trial
        changed = replace(trial, inputs={**trial.inputs, **inputs})
        return run_trial(changed, self.folder / name)

    def run_on_photographs(self) -> TrialRun:
        """Give the run on the suite's own photographs, which most methods had as inputs anyway."""
        examples = example_inputs(self.method)
        if all(self.witness.trial.inputs.get(name) is given for name, given in examples.items()):
            return self.witness.first.run
        return run_trial(replace(self.witness.trial, inputs=examples), self.folder / "photographs")

    def run_cancelled(self) -> TrialRun:
        """Run the method in a step that was cancelled before it began."""
        return run_trial(self.witness.trial, self.folder / "cancelled", is_cancelled=True)


def require(holds: object, sentence: str) -> None:
    """Fail a check with one sentence unless something holds.

    Raises:
        AssertionError: it does not.
    """
    if not holds:
        raise AssertionError(sentence)
