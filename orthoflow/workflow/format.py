"""The workflow format, stated once: the keys that a file may hold, and the data they become.

The checks with their sentences, the JSON Schema and `docs/workflow-format.md` are made of these
keys. What one key has to do with another (references, ports, variants) is checked where it is
read: `inputs`, `steps`, `wiring`, `parameters`, `comparison`.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

from orthoflow.files.yaml_positions import Entry
from orthoflow.products.product import JsonValue
from orthoflow.workflow.dataset_files import TableOr
from orthoflow.workflow.problems import Problem
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
    OpenTable,
    Reference,
    Section,
    Wires,
    whole_number,
)
from orthoflow.workflow.swept_values import SweptValues

FORMAT: Final = 1
MOST_REPEATS: Final = 10_000
# What datasets are called in assignments and addresses, where steps stand otherwise.
DATA: Final = "data"
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
        said_in: the table of datasets and the line in it that name the files, `rooms.csv:3`; empty
            for the workflow itself.
        place: where they are named, `hall.yaml:3:9: inputs.scan.files: `; empty for what comes from
            no file.
    """

    name: str
    files: tuple[str, ...] = ()
    optional: bool = False
    folder: Path = Path()
    is_given: bool = False
    said_in: str = ""
    place: Problem | None = field(default=None, compare=False)


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
SWEEP: Final = Key(
    name="sweep",
    shape=SweptValues(),
    meaning="Values of the parameter, each of which makes a variant.",
    example="[0.02, 0.05, 0.1]",
    missing="a sweep needs the key sweep",
)
SWEPT: Final = Section(
    words="a sweep",
    about="In the place of a value a parameter may be given several: `tolerance_m: {sweep: [0.02, "
    "0.05]}` makes the variants `tolerance_m-0_02` and `tolerance_m-0_05` of the step, or of its "
    "variant, whose name then stands in front, and by which `baseline` and `exclude` still know "
    "it. Several swept parameters make all combinations. A "
    "workflow with a sweep is a comparison, with `compare` or without, and its report draws the "
    "metrics over the parameter. `--set STEP.PARAM=VALUE` takes the place of a sweep, and `--set "
    "'STEP.PARAM={sweep: [...]}'` makes one.",
    keys=(SWEEP,),
)
PARAMS: Final = Key(
    name="params",
    shape=PARAMETERS,
    meaning="Parameters of the method, each a value or a sweep; `orthoflow plugins show ID` lists "
    "them.",
    example="{gsd_m: 0.003, tolerance_m: {sweep: [0.02, 0.05, 0.1]}}",
    default="the method's defaults",
)
REPEAT: Final = Key(
    name="repeat",
    shape=whole_number(minimum=1, maximum=MOST_REPEATS),
    meaning="How many runs with seeds of their own; of a method without randomness, to time it. "
    "An inspection that takes products with randomness looks at every repeat, all else at the "
    "first.",
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
    about="How one method is called. All variants of a step share its wiring (`in`, `if`, "
    "`unless`).",
    keys=(USE, PARAMS, REPEAT, RESOURCES, TIMEOUT),
)
UNLESS: Final = Key(
    name="unless",
    shape=InputSource(),
    meaning="The step is skipped when this input is given.",
    example="inputs.scan",
    default="the step always runs",
)
IF: Final = Key(
    name="if",
    shape=InputSource(),
    meaning="The step is skipped unless this input is given, also where its ports do without.",
    example="inputs.other",
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
    keys=(USE, IN, *CALL.keys[1:], IF, UNLESS, VARIANTS),
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
        only_if: the step is skipped when this input is absent; empty for always.
        unless: the step is skipped when this input is present; empty for always.
        is_varied: the file lists variants, even if only one.
    """

    name: str
    variants: tuple[StepVariant, ...]
    inputs: Mapping[str, tuple[Reference, ...]] = field(default_factory=dict)
    only_if: str = ""
    unless: str = ""
    is_varied: bool = False

    def variant(self, name: str) -> StepVariant:
        """Give the variant of that name."""
        return next(variant for variant in self.variants if variant.name == name)

    @property
    def asked_inputs(self) -> frozenset[str]:
        """Inputs whose presence alone decides whether the step runs."""
        return frozenset((self.only_if, self.unless)) - {""}

    def upstream(self) -> tuple[str, ...]:
        """Names of the steps that the ports may take products from, each once."""
        names = (
            reference.source
            for references in self.inputs.values()
            for reference in references
            if not reference.is_input
        )
        return tuple(dict.fromkeys(names))


# Datasets -----------------------------------------------------------------------------------------

SET: Final = Key(
    name="set",
    shape=OpenTable(words="a mapping step.parameter: value"),
    meaning="Parameters for this dataset alone, named as behind `--set`, which goes before them.",
    example="{room.noise_m: 0.004, plane.ransac.tolerance_m: 0.03}",
    default="as in the steps",
)
DATASET: Final = Section(
    words="a dataset",
    about="What hangs on the data runs once per dataset, with `data=<name>` first in its address; "
    "all else runs once. An input that a dataset does not name is that of the workflow. Instead of "
    "the mapping there may be a CSV file with a line per dataset: the column `name`, a column per "
    "input, and columns such as `room.noise_m` for parameters; an empty place says nothing, and "
    "relative paths start at the CSV file. `--datasets FILE` takes the place of the section, "
    "`--only-data A,B` chooses among the names.",
    keys=(SET,),
    others=Key(
        name="<input>",
        shape=FILES.shape,
        meaning="Files of the input of that name, which have to be there.",
        example="data/hall/*.jpg",
        default="the workflow's own",
    ),
)


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """One of the datasets that a workflow runs on.

    Attributes:
        name: name of the dataset.
        inputs: input -> its files; that of the input `scan` has the name `scan@<dataset>`.
        sets: parameters as written, `step.parameter` -> JSON.
        calls: (step, variant) -> the method call with these parameters, where they change it; not
            kept in records, whose cells say it.
    """

    name: str
    inputs: Mapping[str, WorkflowInputSpec] = field(default_factory=dict)
    sets: Mapping[str, JsonValue] = field(default_factory=dict)
    calls: Mapping[tuple[str, str], StepVariant] = field(default_factory=dict)


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
    "differs. Tables list each of these runs as a step of its own, by its address: the step, the "
    "variants that make it and the repeat, `ortho@plane=ransac,orient=pnp#2`; columns and keys of "
    "files call the address `cell`. Without a comparison only the baseline runs, the first variant "
    "of each step.",
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
NAMED_DATASETS: Final = Named(
    words="a mapping from names to datasets", item=DATASET, empty="expected at least one dataset"
)
DATASETS: Final[Key[str | tuple[Entry, ...]]] = Key(
    name="datasets",
    shape=TableOr(other=NAMED_DATASETS, example="{hall: {scan: hall.e57}}"),
    meaning="What the workflow runs on, one after the other; the runs are one comparison.",
    example="{hall: {scan: data/hall.e57}, stairs: {scan: data/stairs.e57}}",
    default="the workflow runs once, on its inputs",
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
    keys=(ORTHOFLOW, NAME, SEED, INPUTS, DATASETS, STEPS, COMPARE),
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
        datasets: by name; empty when the workflow runs once, on its inputs.
        only_data: names of the datasets to run on; empty for all.
    """

    name: str
    path: Path
    source: str
    seed: int
    inputs: Mapping[str, WorkflowInputSpec]
    steps: Mapping[str, WorkflowStep]
    compare: Comparison | None = None
    overrides: tuple[str, ...] = ()
    datasets: Mapping[str, Dataset] = field(default_factory=dict)
    only_data: tuple[str, ...] = ()

    @property
    def chosen_data(self) -> tuple[Dataset, ...]:
        """The datasets to run on, in the order of the file."""
        chosen = self.only_data or tuple(self.datasets)
        return tuple(item for item in self.datasets.values() if item.name in chosen)

    @cached_property
    def data_inputs(self) -> frozenset[str]:
        """Inputs that datasets name; of all datasets, so that a choice moves no address."""
        return frozenset(name for item in self.datasets.values() for name in item.inputs)

    @cached_property
    def data_calls(self) -> frozenset[tuple[str, str]]:
        """(step, variant) of the method calls whose parameters datasets change."""
        return frozenset(call for item in self.datasets.values() for call in item.calls)

    @cached_property
    def input_specs(self) -> Mapping[str, WorkflowInputSpec]:
        """Every input that cells may take, by its own name: `scan`, `scan@hall`."""
        chosen = self.chosen_data
        shared = {
            name: spec
            for name, spec in self.inputs.items()
            if not chosen or any(name not in item.inputs for item in chosen)
        }
        return shared | {spec.name: spec for item in chosen for spec in item.inputs.values()}

    def with_input_specs(self, specs: Mapping[str, WorkflowInputSpec]) -> Workflow:
        """Put other inputs, by their own names, in the place of those that are there."""
        return replace(
            self,
            inputs={name: specs.get(name, spec) for name, spec in self.inputs.items()},
            datasets={
                item.name: replace(
                    item,
                    inputs={name: specs.get(spec.name, spec) for name, spec in item.inputs.items()},
                )
                for item in self.datasets.values()
            },
        )

    @property
    def baseline(self) -> dict[str, str]:
        """Variant of every varied step that runs when nothing is compared."""
        chosen = self.compare.baseline if self.compare else {}
        return {
            step.name: chosen.get(step.name, step.variants[0].name)
            for step in self.steps.values()
            if step.is_varied
        }
