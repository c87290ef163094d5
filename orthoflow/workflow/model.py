"""A checked workflow as plain data: inputs, steps, variants and the comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from orthoflow.products.product import JsonValue

INPUTS: Final = "inputs"
Design = Literal["product", "one-at-a-time"]


@dataclass(frozen=True, kw_only=True)
class WorkflowInputSpec:
    """An input as the file or the command line names it; nothing is looked up yet.

    Attributes:
        name: name of the input.
        files: files, folders and glob patterns; empty when none were given.
        optional: steps that need it are skipped when it is absent.
        folder: what relative paths start from: the workflow's folder, or the working directory
            for paths from the command line.
        is_given: named with `--input`, so it must exist even when optional.
    """

    name: str
    files: tuple[str, ...] = ()
    optional: bool = False
    folder: Path = Path()
    is_given: bool = False


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Where a port may take its product from.

    Attributes:
        source: name of a step, or `inputs`.
        name: output port of the step, or name of the input.
    """

    source: str
    name: str

    @property
    def is_input(self) -> bool:
        """Whether it names an input of the workflow."""
        return self.source == INPUTS

    def __str__(self) -> str:
        return f"{self.source}.{self.name}"


@dataclass(frozen=True, kw_only=True)
class StepVariant:
    """One of a step's alternatives; a step without variants has exactly one, named ``.

    Attributes:
        name: name of the variant, empty for a step without variants.
        method: method id.
        params: resolved parameters, defaults included, JSON.
        params_set: parameters as written in the file or set on the command line, JSON.
        repeat: how many runs with seeds of their own.
        cores: cores asked for, None for all.
        timeout_s: seconds, None for no limit.
    """

    name: str
    method: str
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    repeat: int = 1
    cores: int | None = None
    timeout_s: float | None = None


@dataclass(frozen=True, kw_only=True)
class WorkflowStep:
    """A step.

    Attributes:
        name: name of the step.
        variants: alternatives in the order of the file.
        inputs: port -> references; the first that is present wins.
        unless: the step is skipped when this input is present; empty for always.
        is_varied: the file lists variants, even if only one.
    """

    name: str
    variants: tuple[StepVariant, ...]
    inputs: Mapping[str, tuple[Reference, ...]] = field(default_factory=dict)
    unless: str = ""
    is_varied: bool = False

    def variant(self, name: str) -> StepVariant:
        """Give the variant of that name."""
        return next(variant for variant in self.variants if variant.name == name)

    def upstream(self) -> tuple[str, ...]:
        """Names of the steps that the ports may take products from, each once."""
        names = (
            reference.source
            for references in self.inputs.values()
            for reference in references
            if not reference.is_input
        )
        return tuple(dict.fromkeys(names))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What to compare.

    Attributes:
        design: all combinations of variants, or the baseline and every single deviation from it.
        baseline: step -> variant, for every varied step.
        exclude: combinations to leave out; a cell whose assignment contains one is dropped.
        metrics: `step.metric` patterns for the report, `*` allowed.
    """

    design: Design = "product"
    baseline: Mapping[str, str] = field(default_factory=dict)
    exclude: tuple[Mapping[str, str], ...] = ()
    metrics: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Workflow:
    """A workflow that was checked against the catalog.

    Attributes:
        name: name of the workflow.
        path: the file it was read from.
        source: text of the file as written.
        seed: root of all seeds.
        inputs: by name.
        steps: by name, in the order of the file.
        compare: what to compare; None when only the baseline runs.
        overrides: `--set ...` and `--input ...` that changed the document, in order; of files
            only the names are kept.
    """

    name: str
    path: Path
    source: str
    seed: int
    inputs: Mapping[str, WorkflowInputSpec]
    steps: Mapping[str, WorkflowStep]
    compare: Comparison | None = None
    overrides: tuple[str, ...] = ()

    @property
    def baseline(self) -> dict[str, str]:
        """Variant of every varied step that runs when nothing is compared."""
        chosen = self.compare.baseline if self.compare else {}
        return {
            step.name: chosen.get(step.name, step.variants[0].name)
            for step in self.steps.values()
            if step.is_varied
        }
