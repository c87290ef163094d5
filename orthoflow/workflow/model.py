"""The workflow format: models of the file, and the checked workflow.

The models of the file define the format: the checks of single keys, the JSON Schema and
`docs/workflow-format.md` are derived from them. Relations between keys are checked in `document`
and `checks`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    Strict,
    WithJsonSchema,
)
from pydantic_core import PydanticCustomError

from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.products.product import JsonValue
from orthoflow.workflow.source import Problem

FORMAT: Final = 1
#: repeats of a method call
MOST_REPEATS: Final = 10_000
# More values would be impractical to run and unreadable in a curve.
#: values of a sweep
MOST_SWEPT: Final = 100
#: combinations in `exclude`
MOST_EXCLUDED: Final = 500
# All JSON readers represent integers up to this value exactly.
_MOST_OF_A_NUMBER: Final = 10**15
INPUTS: Final = "inputs"
# Factors in addresses that are not steps: dataset and seed.
DATA: Final = "data"
SEED: Final = "seed"
NAME_RULE: Final = (
    "a name starts with a lower-case letter, has at most 32 lower-case letters, digits, - or _, "
    "and is not a reserved Windows device name (con, prn, aux, nul, com1, lpt1 ...)"
)
Design = Literal["product", "one-at-a-time"]
_TIME: Final = re.compile(r"(\d+(?:\.\d+)?) *(s|min|h)")
_SECONDS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}
_REFERENCE: Final = re.compile(rf"({NAME_PATTERN})\.({NAME_PATTERN})")
_METRIC: Final = r"[^.]+\.(.|\n)+"
_Item = TypeVar("_Item")


def check_name(name: str) -> str:
    """Return a name if it is allowed in addresses and file names.

    Raises:
        PydanticCustomError: the name is not allowed; this is a subclass of `ValueError`.
    """
    if not re.fullmatch(NAME_PATTERN, name):
        raise PydanticCustomError(
            "name", f"{{name}} cannot be a name: {NAME_RULE}", {"name": repr(name)}
        )
    return name


def _refusal(code: str, form: str) -> PydanticCustomError:
    return PydanticCustomError(code, "Input should be {form}", {"form": form})


def _seconds(raw: object) -> float:
    """Convert a time to seconds, such as 1800 for `30min`."""
    seconds = 0.0
    if isinstance(raw, int | float) and not isinstance(raw, bool):
        seconds = float(raw)
    elif isinstance(raw, str) and (match := _TIME.fullmatch(raw)):
        seconds = float(match[1]) * _SECONDS[match[2]]
    if not (math.isfinite(seconds) and seconds > 0):
        raise _refusal("time", "a time such as 90s, 30min, 2h or a number of seconds above 0")
    return seconds


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Source of the product on a port.

    Attributes:
        source: name of a step, or `inputs`.
        name: output port of the step, or name of the input.
    """

    source: str
    name: str

    @property
    def is_input(self) -> bool:
        """Whether the reference points to an input of the workflow."""
        return self.source == INPUTS

    def __str__(self) -> str:
        return f"{self.source}.{self.name}"


def _reference(raw: object) -> Reference:
    match = _REFERENCE.fullmatch(raw) if isinstance(raw, str) else None
    if match is None:
        raise _refusal("reference", "step.port or inputs.name")
    return Reference(source=match[1], name=match[2])


def _input_reference(raw: object) -> Reference:
    if not (isinstance(raw, str) and raw.startswith(f"{INPUTS}.")):
        raise _refusal("reference", "an input such as inputs.scan")
    return _reference(raw)


def _metric(pattern: str) -> str:
    if not re.fullmatch(_METRIC, pattern):
        raise _refusal("metric", "step.metric, * allowed")
    return pattern


def _format_version(version: int) -> int:
    if version > FORMAT:
        raise PydanticCustomError(
            "format",
            f"the file has workflow format {version}, but this orthoflow reads {FORMAT}; upgrade "
            "orthoflow",
        )
    return version


def _listed(raw: object) -> object:
    # Strict validation requires a tuple.
    return tuple(raw) if isinstance(raw, list | tuple) else (raw,)


def _each_once(values: list[_Item]) -> list[_Item]:
    if again := [value for index, value in enumerate(values) if value in values[:index]]:
        raise PydanticCustomError(
            "twice", f"{again[0]} occurs twice in the sweep; remove one of them"
        )
    return values


_Name: TypeAlias = Annotated[str, AfterValidator(check_name)]
_Text: TypeAlias = Annotated[str, Strict(), Field(min_length=1)]
_Flag: TypeAlias = Annotated[bool, Strict()]
# Strict integers exclude `true`, which Python treats as an integer.
_Positive: TypeAlias = Annotated[int, Strict(), Field(ge=1, le=_MOST_OF_A_NUMBER)]
_Seed: TypeAlias = Annotated[int, Strict(), Field(ge=0, le=_MOST_OF_A_NUMBER)]
_Repeats: TypeAlias = Annotated[int, Strict(), Field(ge=1, le=MOST_REPEATS)]
_Seconds: TypeAlias = Annotated[
    float,
    BeforeValidator(_seconds),
    WithJsonSchema({"type": ["number", "string"]}),
]
_IS_TEXT: Final = WithJsonSchema({"type": "string"})
_Source: TypeAlias = Annotated[Reference, BeforeValidator(_reference), _IS_TEXT]
_InputSource: TypeAlias = Annotated[Reference, BeforeValidator(_input_reference), _IS_TEXT]
_Metric: TypeAlias = Annotated[str, Strict(), AfterValidator(_metric)]
# Levels are strings, so seeds are converted to strings.
_Level: TypeAlias = Annotated[
    str,
    Field(min_length=1),
    BeforeValidator(lambda raw: str(raw) if type(raw) is int else raw),
    WithJsonSchema({"type": ["string", "integer"]}),
]
_Assignment: TypeAlias = dict[str, _Level]
_Texts: TypeAlias = Annotated[tuple[_Text, ...], Field(min_length=1)]
_References: TypeAlias = Annotated[tuple[_Source, ...], Field(min_length=1)]
_Patterns: TypeAlias = tuple[_Metric, ...]
# A single value, or a non-empty list.
_Files: TypeAlias = Annotated[
    _Texts, BeforeValidator(_listed, json_schema_input_type=_Text | _Texts)
]
_Sources: TypeAlias = Annotated[
    _References, BeforeValidator(_listed, json_schema_input_type=_Source | _References)
]
_Metrics: TypeAlias = Annotated[
    _Patterns, BeforeValidator(_listed, json_schema_input_type=_Metric | _Patterns)
]


class FileSection(BaseModel):
    """A mapping with fixed keys in a workflow file."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, arbitrary_types_allowed=True, defer_build=True
    )


class InputSection(FileSection):
    """A folder stands for all files in it and in its subfolders. A pattern stands for the files
    that it matches (`**`: folders at any depth). The files must exist unless the input is optional.
    """  # noqa: D205 - the text of the reference

    files: _Files = Field(
        (),
        description="A file, a folder, a pattern, or a list of these, relative to the workflow. "
        "If this key is missing, pass the files with `--input NAME=PATH`.",
        examples=["data/photos/*.jpg"],
    )
    optional: _Flag = Field(
        default=False,
        description="If the input is absent, steps that need it are skipped.",
        examples=[True],
    )


class ResourcesSection(FileSection):
    """The resources that a method may use."""

    cores: _Positive | None = Field(
        None,
        description="Number of cores that the method may use; by default all cores, shared by the "
        "steps that run at the same time.",
        examples=[2],
    )


class SweepSection(FileSection):
    """A parameter can have several values: `tolerance_m: {sweep: [0.02, 0.05]}` makes the variants
    `tolerance_m-0_02` and `tolerance_m-0_05` of the step. A sweep inside a variant adds the name of
    that variant (`ransac-tolerance_m-0_02`); `baseline` and `exclude` accept `ransac` for all of
    them. If a value cannot be part of a name, the variants are numbered (`sweep-1`), and
    `orthoflow plan` lists them. Sweeps of several parameters give all combinations of their values.
    The report plots the metrics against the parameter. `--set STEP.PARAM=VALUE` replaces a sweep
    with a value, and `--set 'STEP.PARAM={sweep: [...]}'` replaces a value with a sweep.
    """  # noqa: D205

    sweep: Annotated[list[Any], Field(min_length=2, max_length=MOST_SWEPT)] = Field(
        description="Values of the parameter; each becomes a variant.",
        examples=[[0.02, 0.05, 0.1]],
    )


class CallSection(FileSection):
    """All variants of a step have the same inputs and conditions (`in`, `if`, `unless`)."""

    use: _Text | None = Field(
        None,
        description="The method, as `kind.method`; `orthoflow plugins list` shows all methods. "
        "This key is required unless the step has variants.",
        examples=["plane.hough2d"],
    )
    params: dict[str, Any] = Field(
        {},
        description="Parameters, each a value or a sweep; `orthoflow plugins show ID` lists them.",
        examples=[{"gsd_m": 0.003, "tolerance_m": {"sweep": [0.02, 0.05, 0.1]}}],
    )
    repeat: _Repeats = Field(
        1,
        description="Number of runs with different seeds. For a method without randomness, "
        "repeats only measure times. Steps listed in `compare.metrics` (by default all "
        "inspections), and the steps between this step and these, run once per repeat; all other "
        "steps use the first repeat.",
        examples=[10],
    )
    resources: ResourcesSection = Field(
        ResourcesSection(),
        description="The resources that the method may use.",
        examples=[{"cores": 2}],
    )
    timeout: _Seconds | None = Field(
        None,
        description="A step that takes longer is stopped and fails; by default there is no limit.",
        examples=["30min"],
    )


class StepSection(CallSection):
    """A step contains either the keys of one method call, or variants that each contain the keys of
    a method call. If optional data is missing, steps that need this data are skipped, as are all
    steps that depend on them. Steps can be listed in any order.
    """  # noqa: D205

    in_: dict[str, _Sources] = Field(
        {},
        alias="in",
        description="Source of the product for each port. If a list is given, the first available "
        "source is used.",
        examples=[{"cloud": "cloud.cloud", "planes": ["given.planes", "plane.planes"]}],
    )
    if_: _InputSource | None = Field(
        None,
        alias="if",
        description="The step runs only if this input is given, even if no port needs it.",
        examples=["inputs.other"],
    )
    unless: _InputSource | None = Field(
        None,
        description="The step is skipped if this input is given.",
        examples=["inputs.scan"],
    )
    variants: dict[_Name, CallSection] | None = Field(
        None,
        description="Alternative methods of one kind with their own parameters, instead of `use`.",
        examples=[{"fine": {"use": "plane.hough2d"}, "quick": {"use": "plane.ransac"}}],
    )


class DatasetSection(BaseModel):
    """Steps that depend on the data run once per dataset, and their addresses begin with
    `data=<name>`; all other steps run once. Inputs that a dataset does not list are taken from the
    workflow. Alternatively, list the datasets in a CSV file, one per line, with a column `name`, a
    column per input, and columns such as `room.noise_m` for parameters. An empty field leaves the
    parameter unchanged. Paths are relative to the CSV file. `--datasets FILE` replaces this
    section, and `--only-data A,B` selects datasets.
    """  # noqa: D205

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, _Files]

    set: dict[str, Any] = Field(
        {},
        description="Parameters of this dataset, named as in `--set`, and `seed` (a number or a "
        "sweep). `--set` overrides them.",
        examples=[{"room.noise_m": 0.004, "plane.ransac.tolerance_m": 0.03, "seed": 7}],
    )


class DatasetsSection(FileSection):
    """The datasets from a file, from a table, or given from Python."""

    datasets: dict[_Name, DatasetSection]


class Comparison(FileSection):
    """A step that depends on variants runs once per combination that affects it. Each of these runs
    is a cell. The address of a cell, such as `ortho@plane=ransac,orient=pnp#2`, consists of the
    step, dataset, seed, variants and repeat. Without `compare`, only the baseline runs, which is
    the first variant of each step.
    """  # noqa: D205

    design: Design = Field(
        "product",
        description="`product`: all combinations of variants; `one-at-a-time`: the baseline and "
        "every combination that differs from it in one step.",
        examples=["one-at-a-time"],
    )
    baseline: _Assignment = Field(
        {},
        description="For each step, the variant that the report shows and with which it compares "
        "the other variants; by default the first one.",
        examples=[{"plane": "hough2d", "orient": "bundle"}],
    )
    exclude: tuple[Annotated[_Assignment, Field(min_length=1)], ...] = Field(
        (),
        max_length=MOST_EXCLUDED,
        description="Combinations that do not run.",
        examples=[[{"plane": "ransac", "orient": "pnp"}]],
    )
    metrics: _Metrics = Field(
        (),
        description="Metrics in the tables of the report, as `step.metric`, with `*` as a "
        "wildcard; by default all quality metrics.",
        examples=[["plane.rms_mm", "*.wall_s"]],
    )


class SeedSweep(FileSection):
    """Several seeds: random steps run once per seed, with `seed=<n>` in their address."""

    sweep: Annotated[
        list[_Seed], Field(min_length=2, max_length=MOST_SWEPT), AfterValidator(_each_once)
    ]


class SeedSection(FileSection):
    """The seed of a workflow or of a dataset."""

    seed: _Seed | SeedSweep = 0

    @property
    def seeds(self) -> tuple[int, ...]:
        """Return the seed, or all seeds of a sweep."""
        return tuple(self.seed.sweep) if isinstance(self.seed, SeedSweep) else (self.seed,)


class WorkflowFile(FileSection):
    """A workflow file is a YAML 1.2 file that contains only data. Templates, expressions,
    environment variables and tags are not supported. Duplicate keys and names are errors.
    """  # noqa: D205

    orthoflow: Annotated[
        _Positive,
        AfterValidator(_format_version),
        WithJsonSchema({"const": FORMAT}),
    ] = Field(FORMAT, description="Version of this format.", examples=[FORMAT])
    name: _Name | None = Field(
        None,
        description="Name of the workflow and prefix of its run folders; by default the file name.",
        examples=["palace-room"],
    )
    seed: _Seed | SeedSweep = Field(
        0,
        description="The seed of each random step is derived from this seed, the method and the "
        "repeat. A sweep runs every random step once per seed.",
        examples=[1729],
    )
    inputs: dict[_Name, InputSection] = Field(
        {},
        description="Input files; steps refer to them as `inputs.<name>`.",
        examples=[{"scan": {"files": "data/room.e57"}, "photos": {"optional": True}}],
    )
    datasets: dict[_Name, DatasetSection] | str = Field(
        {},
        description="The datasets on which the workflow runs: a mapping or a CSV file.",
        examples=[{"hall": {"scan": "data/hall.e57"}, "stairs": {"scan": "data/stairs.e57"}}],
    )
    steps: dict[_Name, StepSection] = Field(
        {},
        description="The steps, each of which calls a method.",
        examples=[{"cloud": {"use": "read.scan", "in": {"files": "inputs.scan"}}}],
    )
    compare: Comparison | None = Field(
        None,
        description="The combinations of variants to run and the metrics to compare.",
        examples=[{"design": "product", "baseline": {"plane": "hough2d"}}],
    )


# A reference as it is written in records.
_Recorded: TypeAlias = Annotated[Reference, BeforeValidator(_reference), PlainSerializer(str)]


@dataclass(frozen=True, kw_only=True)
class WorkflowInputSpec:
    """An input as given in the file or on the command line, before its files are located.

    Attributes:
        name: name of the input.
        files: files, folders and glob patterns; empty if none are given.
        optional: whether steps that need the input are skipped if it is missing.
        folder: base folder of relative paths: the folder of the workflow, or the working directory
            for paths from the command line.
        is_given: whether the files were given with `--input` and must therefore exist even if the
            input is optional.
        table: datasets table and line that name the files, e.g. `rooms.csv:3`; empty if the
            workflow names them.
        place: position in the document where the files are named; None if they do not come from a
            document.
    """

    name: str
    files: tuple[str, ...] = ()
    optional: bool = False
    folder: Path = Path()
    is_given: bool = False
    table: str = ""
    place: Problem | None = field(default=None, compare=False)


@dataclass(frozen=True, kw_only=True)
class StepVariant:
    """A variant of a step; a step without variants has a single one with an empty name.

    Attributes:
        name: name of the variant; empty for a step without variants.
        method: method id.
        params: resolved parameters with defaults, as JSON.
        params_set: parameters set in the file or on the command line, as JSON.
        repeat: number of executions, with different seeds if the method is random.
        cores: requested number of cores; None for all.
        timeout_s: time limit in seconds; None if there is none.
        swept: swept parameter -> value in this variant; a subset of `params_set`.
        family: for a swept variant, its name in the workflow file, without the values; not in the
            record.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: str
    method: Annotated[str, Field(alias="use")]
    # The values are JSON.
    params: Mapping[str, Any] = field(default_factory=dict)
    params_set: Mapping[str, Any] = field(default_factory=dict)
    repeat: Annotated[int, Field(ge=1, le=MOST_REPEATS)] = 1
    cores: Annotated[int, Field(ge=1)] | None = None
    timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    swept: Mapping[str, Any] = field(default_factory=dict)
    family: Annotated[str, Field(exclude=True)] = ""


@dataclass(frozen=True, kw_only=True)
class WorkflowStep:
    """A step of a workflow.

    Attributes:
        name: name of the step.
        variants: variants in the order of the file.
        inputs: port -> references, of which the first available one is used.
        only_if: input without which the step is skipped; empty if there is no condition.
        unless: input with which the step is skipped; empty if there is no condition.
        is_varied: whether the step has variants, even if there is only one.
    """

    name: Annotated[str, Field(exclude=True)] = ""
    variants: tuple[StepVariant, ...]
    inputs: Annotated[Mapping[str, tuple[_Recorded, ...]], Field(alias="in")] = field(
        default_factory=dict
    )
    only_if: Annotated[str, Field(alias="if")] = ""
    unless: str = ""
    is_varied: bool = False

    def variant(self, name: str) -> StepVariant:
        """Return the variant with this name."""
        return next(variant for variant in self.variants if variant.name == name)

    @property
    def conditions(self) -> frozenset[str]:
        """The inputs in the conditions `if` and `unless`."""
        return frozenset((self.only_if, self.unless)) - {""}

    @property
    def references(self) -> tuple[Reference, ...]:
        """The possible sources of all ports."""
        return tuple(item for references in self.inputs.values() for item in references)

    def upstream(self) -> tuple[str, ...]:
        """Return the names of the steps whose products this step may use, without duplicates."""
        return tuple(dict.fromkeys(one.source for one in self.references if not one.is_input))


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """One of the datasets of a workflow.

    Attributes:
        name: name of the dataset.
        inputs: input -> files; for the input `scan`, the name in the value is `scan@<dataset>`.
        sets: `step.parameter` -> value, as written.
        seeds: root seeds of this dataset; if empty, the seeds of the workflow are used.
        calls: (step, variant) -> method call with the parameters of this dataset, for calls that
            they change. Calls are not stored in records, because the recorded cells contain the
            parameters.
    """

    name: str
    inputs: Mapping[str, WorkflowInputSpec] = field(default_factory=dict)
    sets: Mapping[str, JsonValue] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    calls: Mapping[tuple[str, str], StepVariant] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Workflow:
    """A workflow that has been checked against the catalog.

    Attributes:
        name: name of the workflow.
        path: path of the file.
        source: text of the file as written.
        seed: root seed; the first value if the seed is swept.
        seeds: values of the root seed if it is swept; otherwise empty.
        inputs: name -> input.
        steps: name -> step, in the order of the file.
        compare: the comparison; None if only the baseline runs.
        overrides: options that changed the workflow, such as `--set ...`, in order; file names have
            no folders.
        datasets: name -> dataset; empty if the workflow runs once, on its own inputs.
        only_data: names of the selected datasets; empty for all.
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
    seeds: tuple[int, ...] = ()

    @property
    def chosen_data(self) -> tuple[Dataset, ...]:
        """The selected datasets, in the order of the file."""
        chosen = self.only_data or tuple(self.datasets)
        return tuple(item for item in self.datasets.values() if item.name in chosen)

    @cached_property
    def data_inputs(self) -> frozenset[str]:
        """Names of the inputs that datasets set.

        Datasets that are not selected are included, so that a selection changes no address.
        """
        return frozenset(name for item in self.datasets.values() for name in item.inputs)

    @cached_property
    def data_calls(self) -> frozenset[tuple[str, str]]:
        """Step and variant of the method calls whose parameters datasets change."""
        return frozenset(call for item in self.datasets.values() for call in item.calls)

    @cached_property
    def has_data_seeds(self) -> bool:
        """Whether datasets have their own seeds."""
        return any(item.seeds for item in self.datasets.values())

    @cached_property
    def has_seeds(self) -> bool:
        """Whether the seed is a factor, which the addresses of random steps contain."""
        return bool(self.seeds) or self.has_data_seeds

    def seeds_of(self, dataset: Dataset | None) -> tuple[int, ...]:
        """Return the root seeds for a dataset."""
        return (dataset.seeds if dataset else ()) or self.seeds or (self.seed,)

    @cached_property
    def input_specs(self) -> Mapping[str, WorkflowInputSpec]:
        """Name, such as `scan` or `scan@hall`, -> input, for all inputs that cells may use."""
        chosen = self.chosen_data
        shared = {
            name: spec
            for name, spec in self.inputs.items()
            if not chosen or any(name not in item.inputs for item in chosen)
        }
        return shared | {spec.name: spec for item in chosen for spec in item.inputs.values()}

    def with_input_specs(self, specs: Mapping[str, WorkflowInputSpec]) -> Workflow:
        """Return the workflow with some inputs replaced by those of the same name."""
        datasets = {
            item.name: replace(
                item, inputs={name: specs.get(one.name, one) for name, one in item.inputs.items()}
            )
            for item in self.datasets.values()
        }
        inputs = {name: specs.get(name, spec) for name, spec in self.inputs.items()}
        return replace(self, inputs=inputs, datasets=datasets)

    @property
    def baseline(self) -> dict[str, str]:
        """Step -> variant that runs without a comparison, for each step with variants."""
        chosen = self.compare.baseline if self.compare else {}
        return {
            step.name: chosen.get(step.name, step.variants[0].name)
            for step in self.steps.values()
            if step.is_varied
        }


def factors_of(workflow: Workflow) -> frozenset[str]:
    """Return the factors in addresses that are not steps, which are `data` and `seed`."""
    data = {DATA} if workflow.datasets else set()
    return frozenset(data | ({SEED} if workflow.has_seeds else set()))


def is_acyclic(sources: Mapping[str, Sequence[str]]) -> bool:
    """Whether no step depends on itself, directly or indirectly."""
    try:
        TopologicalSorter(sources).prepare()
    except CycleError:
        return False
    return True
