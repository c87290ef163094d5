"""The workflow format, stated once: the keys that a file may hold, and the data they become.

The checks with their sentences, the JSON Schema and `docs/workflow-format.md` are made of these
keys. What one key has to do with another (references, ports, variants) is checked where it is
read: `inputs`, `steps`, `wiring`, `parameters`, `comparison`.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from orthoflow.products.product import JsonValue
from orthoflow.workflow.shapes import (
    ASSIGNMENT,
    FLAG,
    INPUTS_NAME,
    PARAMETERS,
    TEXT,
    TIME_SPAN,
    Assignments,
    Choice,
    FormatVersion,
    InputSource,
    Key,
    MetricPatterns,
    Name,
    Named,
    OneOrMore,
    Reference,
    Section,
    Wires,
    whole_number,
)

FORMAT: Final = 1
MOST_REPEATS: Final = 10_000
Design = Literal["product", "one-at-a-time"]


# Inputs -------------------------------------------------------------------------------------------

FILES: Final = Key(
    name="files",
    shape=OneOrMore(TEXT),
    meaning="A file, a folder, a pattern, or a list of them; relative paths start at the workflow.",
    example="data/photos/*.jpg",
    default="none, until `--input NAME=PATH` gives some",
)
OPTIONAL: Final = Key(
    name="optional",
    shape=FLAG,
    meaning="The workflow can do without it: steps that need it are skipped when it is absent.",
    example="true",
    default="`false`",
)
INPUT: Final = Section(
    words="an input",
    about="A folder stands for the files directly in it, a pattern for the files it matches (`**` "
    "for folders at any depth). A file that is named, and is not optional, has to be there.",
    keys=(FILES, OPTIONAL),
)


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


# Steps --------------------------------------------------------------------------------------------

USE: Final = Key(
    name="use",
    shape=TEXT,
    meaning="The method, as `kind.method`; `orthoflow plugins list` names all.",
    example="plane.hough2d",
    default="refused, unless the step has variants",
)
IN: Final = Key(
    name="in",
    shape=Wires(),
    meaning="Where each port's product comes from; of a list, the first that is present.",
    example="{cloud: cloud.cloud, planes: [given.planes, plane.planes]}",
    default="no port is wired",
)
PARAMS: Final = Key(
    name="params",
    shape=PARAMETERS,
    meaning="Parameters of the method; `orthoflow plugins show ID` lists them.",
    example="{gsd_m: 0.003}",
    default="the method's defaults",
)
REPEAT: Final = Key(
    name="repeat",
    shape=whole_number(minimum=1, maximum=MOST_REPEATS),
    meaning="How many runs with seeds of their own; of a method without randomness, to time it. "
    "What follows takes the first.",
    example="10",
    default="1",
)
CORES: Final = Key(
    name="cores",
    shape=whole_number(minimum=1),
    meaning="How many cores the method may use.",
    example="2",
    default="all, shared by the steps that run at the same time",
)
SHARE: Final = Section(
    words="a mapping", about="What a method may take of the machine.", keys=(CORES,)
)
RESOURCES: Final = Key(
    name="resources",
    shape=SHARE,
    meaning="What the method may take of the machine.",
    example="{cores: 2}",
    default="as without its keys",
)
TIMEOUT: Final = Key(
    name="timeout",
    shape=TIME_SPAN,
    meaning="The step is ended, and has failed, when it takes longer.",
    example="30min",
    default="no limit",
)
CALL: Final = Section(
    words="a method call",
    about="How one method is called. All variants of a step share its wiring (`in`, `unless`).",
    keys=(USE, PARAMS, REPEAT, RESOURCES, TIMEOUT),
)
UNLESS: Final = Key(
    name="unless",
    shape=InputSource(),
    meaning="The step is skipped when this input is given.",
    example="inputs.scan",
    default="the step always runs",
)
VARIANTS: Final = Key(
    name="variants",
    shape=Named(
        words="a mapping from names to method calls",
        item=CALL,
        empty="expected at least one variant",
    ),
    meaning="Alternatives of one kind, each with its own parameters, in the place of `use`.",
    example="{fine: {use: plane.hough2d, params: {cell_m: 0.02}}, quick: {use: plane.ransac}}",
    default="the step has only one way",
)
STEP: Final = Section(
    words="a step",
    about="A step calls one method, or has variants that each call one; then what belongs to a "
    "call stands in the variants. A step that lacks a required product, because optional data are "
    "absent, is skipped with all that needs it. Steps may stand in any order.",
    keys=(USE, IN, *CALL.keys[1:], UNLESS, VARIANTS),
)


@dataclass(frozen=True, kw_only=True)
class StepVariant:
    """One of a step's alternatives; a step without variants has exactly one, named ``.

    Attributes:
        name: name of the variant, empty for a step without variants.
        method: method id.
        params: resolved parameters, defaults included, JSON.
        params_set: parameters as written in the file or set on the command line, JSON.
        repeat: how many runs, with seeds of their own where the method is random.
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


# The comparison -----------------------------------------------------------------------------------

DESIGN: Final[Key[Design]] = Key(
    name="design",
    shape=Choice(noun="design", choices=typing.get_args(Design)),
    meaning="All combinations of variants, or the baseline and every single deviation from it.",
    example="one-at-a-time",
    default="`product`",
)
BASELINE: Final = Key(
    name="baseline",
    shape=ASSIGNMENT,
    meaning="The variant of each step that others are compared with, and that a report shows.",
    example="{plane: hough2d, orient: bundle}",
    default="the first variant of each step",
)
EXCLUDE: Final = Key(
    name="exclude",
    shape=Assignments(),
    meaning="Combinations that are left out, wherever they occur.",
    example="[{plane: ransac, orient: pnp}]",
    default="none",
)
METRICS: Final = Key(
    name="metrics",
    shape=MetricPatterns(),
    meaning="What the report's tables show, as `step.metric`; `*` stands for anything.",
    example='[plane.rms_mm, "*.wall_s"]',
    default="those that judge quality",
)
COMPARISON: Final = Section(
    words="a mapping",
    about="Variants fan out: every step behind them runs once per combination that really "
    "differs. Without a comparison only the baseline runs, the first variant of each step.",
    keys=(DESIGN, BASELINE, EXCLUDE, METRICS),
)


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


# The file -----------------------------------------------------------------------------------------

ORTHOFLOW: Final = Key(
    name="orthoflow",
    shape=FormatVersion(FORMAT),
    meaning="Version of this format.",
    example=str(FORMAT),
    missing=f"a workflow begins with orthoflow: {FORMAT}",
)
NAME: Final = Key(
    name="name",
    shape=Name(),
    meaning="Name of the workflow; the folder of a run begins with it.",
    example="palace-room",
    default="the file's name",
)
SEED: Final = Key(
    name="seed",
    shape=whole_number(minimum=0),
    meaning="Root of all seeds: one follows from it, the method and the repeat.",
    example="1729",
    default="0",
)
INPUTS: Final = Key(
    name=INPUTS_NAME,
    shape=Named(words="a mapping from names to inputs", item=INPUT),
    meaning="Files from outside; steps name them `inputs.<name>`.",
    example="{scan: {files: data/room.e57}, photos: {files: data/photos/*.jpg, optional: true}}",
    default="none",
)
STEPS: Final = Key(
    name="steps",
    shape=Named(
        words="a mapping from names to steps",
        item=STEP,
        empty="a workflow needs at least one step",
        taken={INPUTS_NAME: "a step cannot be called inputs, which names files"},
    ),
    meaning="What is done, each step by the method of a plugin.",
    example="{cloud: {use: read.scan, in: {files: inputs.scan}}}",
    missing="a workflow needs the key steps",
)
COMPARE: Final = Key(
    name="compare",
    shape=COMPARISON,
    meaning="Which combinations of variants run, and what of them is compared.",
    example="{design: product, baseline: {plane: hough2d}}",
    default="only the baseline runs",
)
FILE: Final = Section(
    words="a workflow",
    about="A workflow file is YAML 1.2 and data only: no templates, no expressions, no environment "
    "variables, no tags. Every key and every name occurs once.",
    keys=(ORTHOFLOW, NAME, SEED, INPUTS, STEPS, COMPARE),
)


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
