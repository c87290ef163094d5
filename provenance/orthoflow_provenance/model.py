"""What a run says, as plain dataclasses: the one declaration of metric, figure, cell and record.

Methods, store and record use these types, or add to them what only they know. The writer and the
reader go through the fields: a field that is added to `Costs` or `CellOutcome` is recorded, and
those of `Costs` are shown wherever the others are.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Annotated, Any, Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

RUN_FORMAT: Final = "orthoflow-run"
# Of the record; the minor number rises with every field that is added below (SPEC, 1.2).
RUN_FORMAT_VERSION: Final = "1.4"
PRODUCT_FORMAT: Final = "orthoflow-product"
PRODUCT_FORMAT_VERSION: Final = "1.0"

# What a figure may be, and what its file is called.
FIGURE_SUFFIXES: Final[Mapping[str, str]] = {
    "image/png": ".png",
    "image/svg+xml": ".svg",
    "image/webp": ".webp",
    "image/jpeg": ".jpg",
}

JsonValue: TypeAlias = bool | int | float | str | list["JsonValue"] | dict[str, "JsonValue"] | None
CellStatus = Literal["ok", "failed", "skipped"]


class Stored(Enum):
    """How a field lies in HDF5 where its type alone does not say it."""

    DATASET = "a text of any length in a dataset of its own"
    DIGITS = "a whole number of any size as decimal text; empty for None"
    ELSEWHERE = "a group, or the name of one: writer and reader place it by hand"


LongText: TypeAlias = Annotated[str, Stored.DATASET]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """What the annotation of a measured number says of it.

    Attributes:
        label: what tables call it, beside its unit.
        unit: as in metrics.
    """

    label: str
    unit: str


class PayloadLike(Protocol):
    """A product as named arrays and JSON; `orthoflow.products.Payload` is one."""

    @property
    def type_name(self) -> str:
        """Name of the product type."""

    @property
    def encoding_version(self) -> int:
        """Version of the type's layout."""

    @property
    def metadata(self) -> Mapping[str, JsonValue]:
        """Everything that is not an array."""

    @property
    def arrays(self) -> Mapping[str, NDArray[np.generic]]:
        """Arrays by name; names may have `/`."""

    @property
    def mapped(self) -> bool:
        """Store contiguous and uncompressed."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One number with its unit.

    Attributes:
        name: of the number, with its unit at the end where it has one.
        value: finite.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        words: what tables call it, where its method says that; empty without.
        good: with words: which side is good, `less`, `more` or `one`; empty where none is.
    """

    name: str
    value: float
    unit: str
    words: str = ""
    good: str = ""


@dataclass(frozen=True, kw_only=True)
class RecordedDiagnostic:
    """Something that deserves attention, as data.

    Attributes:
        code: stable name, e.g. `scan-without-colour`.
        severity: `error`, `warning` or `note`.
        subject: what it is about, e.g. `scan 0`.
        values: numbers and names that the text is made of.
        text: one sentence.
        remedy: what to do about it; empty where nothing can be done.
        rank_by: name of the value by which the worst of several is chosen, larger is worse; with
            `-` before it smaller is worse.
        settled_by: methods or codes of later steps that settle it.
    """

    code: str
    severity: Literal["error", "warning", "note"]
    subject: str
    values: Mapping[str, bool | int | float | str | None]
    text: str
    remedy: str = ""
    rank_by: str = ""
    settled_by: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What is said of a picture, wherever it is.

    Attributes:
        name: name the method gave.
        caption: one sentence.
        media_type: `image/png`, `image/webp` or `image/svg+xml`.
    """

    name: str
    caption: str
    media_type: str


@dataclass(frozen=True, kw_only=True)
class RecordedFigure(Figure):
    """A picture in a record.

    Attributes:
        data: the bytes of the file.
    """

    data: bytes = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class ProductRef:
    """A product by its content.

    Attributes:
        type_name: product type, `files` for a workflow input.
        encoding_version: version of the type's layout, 0 for files.
        digest: `sha256:` + 64 hexadecimal digits of the logical content.
    """

    type_name: str
    encoding_version: int
    digest: str


@dataclass(frozen=True, kw_only=True)
class RecordedProduct(ProductRef):
    """One output or input of a cell.

    Attributes:
        source: for inputs `address.port` or `inputs.name`; empty for outputs.
        embedded: the arrays are in the record (outputs only).
    """

    source: str = ""
    embedded: bool = False


@dataclass(frozen=True, kw_only=True)
class RecordedFile:
    """One input file, without its folder."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedInput:
    """One workflow input; no files when it was optional and absent.

    Attributes:
        name: name in the workflow.
        files: in the order of their names.
        embedded: the bytes of the files are in the record.
    """

    name: Annotated[str, Stored.ELSEWHERE]
    files: tuple[RecordedFile, ...]
    embedded: Annotated[bool, Stored.ELSEWHERE] = False


@dataclass(frozen=True, kw_only=True)
class PublishedFile:
    """One file that the run wrote for other programs.

    Attributes:
        path: from the folder of the record, with `/`.
        size_bytes: its size.
        sha256: hexadecimal digest of its bytes.
    """

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """Where a cell ran.

    Attributes:
        id: digest of the rest; cells refer to it.
        python: version.
        os: system and release.
        cpu: model name.
        cores: logical processors.
        threads: threads given to the cell.
        git_commit: commit of the code when run from a checkout, with `+changes` when dirty; else
            empty.
        packages: distribution name -> version.
    """

    id: Annotated[str, Stored.ELSEWHERE]
    python: str
    os: str
    cpu: str
    cores: int
    threads: int
    git_commit: str
    packages: Annotated[Mapping[str, str], ("name", "version")]


@dataclass(frozen=True, kw_only=True)
class MethodIdentity:
    """Which code gave a result.

    Attributes:
        method: method id.
        distribution: name of the distribution that brought the method.
        distribution_version: its version.
        result_version: the method's own counter.
        determinism: exact, seeded or loose.
        citations: where the method comes from.
    """

    method: str = ""
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = ""
    citations: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Costs:
    """What one execution of a method took; in a record that of the run that computed it.

    One that came with a later version of the format is None where an older record lacks it.

    Attributes:
        wall_s: seconds on the clock that the method ran, without `compile_s`; with it where
            `compile_s` is None.
        cpu_s: processor seconds of the step's process meanwhile, likewise.
        peak_rss_mib: largest memory of the step's process.
        stored_mib: what its products, their published files and its figures take in the store;
            equal ones of several cells lie there once. None for cells without a result too.
        compile_s: seconds on the clock that the step's process loaded modules and compiled kernels,
            before, in and after the call. It hangs on what ran before, so nothing is ranked by it.
    """

    wall_s: Annotated[float, Quantity(label="time", unit="s")] = 0.0
    cpu_s: Annotated[float, Quantity(label="processor", unit="s")] = 0.0
    peak_rss_mib: Annotated[float, Quantity(label="memory", unit="MiB")] = 0.0
    stored_mib: Annotated[float | None, Quantity(label="stored", unit="MiB")] = None
    compile_s: Annotated[float | None, Quantity(label="loading and compiling", unit="s")] = None


COSTS: Final[Mapping[str, Quantity]] = {
    name: hint.__metadata__[0]
    for name, hint in typing.get_type_hints(Costs, include_extras=True).items()
}


@dataclass(frozen=True, kw_only=True)
class CellOutcome(MethodIdentity, Costs):
    """What a cell came to: the store keeps it, and the record of a run repeats it.

    Attributes:
        status: ok, failed or skipped.
        error_type: class of the error, empty when ok; for skipped cells empty too.
        error_message: one sentence; for skipped cells the reason.
        key: cache key, SHA-256 in hexadecimal digits; empty when never known.
        key_preimage: canonical JSON the key is the digest of.
        seed: seed the generator was made from, None when the method uses none.
        started: ISO 8601 UTC; of the original run for cached cells.
        ended: likewise.
        metrics: what the method reported.
        warnings: what limits the result.
        diagnostics: the same as data, and notes.
        log: text.
    """

    status: CellStatus
    error_type: str = ""
    error_message: LongText = ""
    key: str = ""
    key_preimage: LongText = ""
    seed: Annotated[int | None, Stored.DIGITS] = None
    started: str = ""
    ended: str = ""
    metrics: tuple[Metric, ...] = ()
    warnings: tuple[str, ...] = ()
    diagnostics: tuple[RecordedDiagnostic, ...] = ()
    log: LongText = ""


@dataclass(frozen=True, kw_only=True, repr=False)
class RecordedCell(CellOutcome):
    """One cell of a run: a method applied once.

    Attributes:
        address: `step` or `step@step=variant,...`, `#n` behind it for repeats after the first.
        step: name of the step.
        assignment: step -> variant, in graph order.
        repeat: 0 for the first.
        params: all parameters, resolved.
        params_set: parameters as written, and from the command line.
        environment: id of the environment.
        cached_from: run id of the run that computed it; empty when computed in this run.
        figures: pictures.
        inputs: port -> product.
        outputs: port -> product.
    """

    address: Annotated[str, Stored.ELSEWHERE]
    step: str
    assignment: Annotated[Mapping[str, str], ("step", "variant")] = field(default_factory=dict)
    repeat: int = 0
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    environment: str = ""
    cached_from: str = ""
    figures: Annotated[tuple[RecordedFigure, ...], Stored.ELSEWHERE] = ()
    inputs: Annotated[Mapping[str, RecordedProduct], Stored.ELSEWHERE] = field(default_factory=dict)
    outputs: Annotated[Mapping[str, RecordedProduct], Stored.ELSEWHERE] = field(
        default_factory=dict
    )

    def __repr__(self) -> str:
        # Logs and lists of parameters are for whoever asks for them.
        metrics, figures = len(self.metrics), len(self.figures)
        return (
            f"<RecordedCell {self.address!r}: {self.method}, {self.status}, {self.wall_s:.3g} s, "
            f"{metrics} metrics, {figures} figures>"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunRecord:
    """Everything a record says except the products' arrays.

    Attributes:
        run_id: opaque, unique.
        name: name of the workflow.
        created_by: program and version, e.g. `orthoflow 0.1.0`.
        status: ok, or failed when some cell failed.
        started: ISO 8601 UTC.
        ended: ISO 8601 UTC.
        seed: seed of the workflow.
        workflow_source: the file as written.
        workflow_resolved: canonical JSON of the workflow with all overrides applied.
        overrides: `--set` and other options that changed the workflow or chose among its steps,
            as given.
        inputs: the workflow's inputs.
        environments: each distinct one once.
        cells: in the order of the graph.
        published: files beside the record, for other programs.
    """

    run_id: str
    name: str
    created_by: str
    status: Literal["ok", "failed"]
    started: str
    ended: str
    seed: Annotated[int, Stored.DIGITS]
    workflow_source: Annotated[str, Stored.ELSEWHERE]
    workflow_resolved: Annotated[str, Stored.ELSEWHERE]
    overrides: Annotated[tuple[str, ...], Stored.ELSEWHERE] = ()
    inputs: Annotated[tuple[RecordedInput, ...], Stored.ELSEWHERE] = ()
    environments: Annotated[tuple[RecordedEnvironment, ...], Stored.ELSEWHERE] = ()
    cells: Annotated[tuple[RecordedCell, ...], Stored.ELSEWHERE] = ()
    published: Annotated[tuple[PublishedFile, ...], Stored.ELSEWHERE] = ()

    def __repr__(self) -> str:
        return (
            f"<RunRecord {self.run_id!r} of {self.name!r}: {self.status}, started {self.started}, "
            f"{len(self.cells)} cells>"
        )


def cost_metrics(costs: Costs) -> tuple[Metric, ...]:
    """What was measured as metrics, in the order of the fields; what is not stated is left out."""
    measured = {name: getattr(costs, name) for name in COSTS}
    return tuple(
        Metric(name=name, value=float(value), unit=COSTS[name].unit)
        for name, value in measured.items()
        if value is not None
    )


# Any: keywords for a constructor, whose own annotations say what they are.
def shared_fields(source: object, part: type) -> dict[str, Any]:
    """Give what an object says in the fields of a part that it has, to hand on as keywords."""
    return {item.name: getattr(source, item.name) for item in fields(part)}
