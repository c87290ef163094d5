"""The content of a record, as dataclasses and as one JSON document.

This is the only declaration of metric, figure, cell and record: methods, store and record use these
types or extend them with their own fields. Pydantic reads and writes the document by field, so a
field added here is recorded, and new fields of `Costs` are also shown with the others.
"""

from __future__ import annotations

import hashlib
import json
import math
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Protocol, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydantic import TypeAdapter

RUN_FORMAT: Final = "orthoflow-run"
PRODUCT_FORMAT: Final = "orthoflow-product"
FORMAT_VERSION: Final = "1.0"
DIGEST_PREFIX: Final = "sha256:"

# Allowed media types of figures -> suffix of their files.
FIGURE_SUFFIXES: Final[Mapping[str, str]] = {
    "image/png": ".png",
    "image/svg+xml": ".svg",
    "image/webp": ".webp",
    "image/jpeg": ".jpg",
}

if TYPE_CHECKING:
    JsonValue: TypeAlias = (
        bool | int | float | str | list["JsonValue"] | dict[str, "JsonValue"] | None
    )
else:
    # Pydantic cannot resolve a recursive alias; the content is checked as JSON elsewhere.
    JsonValue = Any
CellStatus = Literal["ok", "failed", "skipped"]


class RecordFormatError(ValueError):
    """A file or value does not conform to the record format: damaged, not allowed or incomplete.

    The message is one sentence with what was found, what was expected, where, and the remedy if
    there is one.
    """


class UnknownFormatError(RecordFormatError):
    """The file is from another program or of another format version, so it cannot be checked."""


class LockedFileError(RecordFormatError):
    """The file is open for writing elsewhere, or was left open by a crash."""


class InputFileError(RecordFormatError):
    """An input file to be embedded is missing or differs from the file that was digested."""


class UnsafeFileError(RecordFormatError):
    """A path leads out of its folder, or does not lead to a regular file."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Label, unit and direction of a measured number.

    Attributes:
        label: name in tables, without the unit.
        unit: unit as in metrics.
        better: which values are better, as in metrics.
    """

    label: str
    unit: str
    better: str = ""


class PayloadLike(Protocol):
    """A product as named arrays and JSON, such as `orthoflow.products.Payload`."""

    @property
    def type_name(self) -> str:
        """Name of the product type."""

    @property
    def encoding_version(self) -> int:
        """Version of the type's encoding."""

    @property
    def metadata(self) -> Mapping[str, JsonValue]:
        """Everything that is not an array."""

    @property
    def arrays(self) -> Mapping[str, NDArray[np.generic]]:
        """Arrays by name; names may contain `/`."""

    @property
    def mapped(self) -> bool:
        """Whether arrays are stored contiguously and uncompressed."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A number with its unit.

    Attributes:
        name: name of the metric, ending with its unit if it has one.
        value: finite value.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        label: name in tables, if the method declares one; otherwise empty.
        better: which values are better: `lower`, `higher` or `one`; empty if there is no better
            direction.
        description: further explanation, one sentence.
        headline: whether the metric describes the quality of the result.
        counted_by: metric of the same step with the number of items summarised; values over
            different numbers of items are not comparable.
    """

    name: str
    value: float
    unit: str
    label: str = ""
    better: str = ""
    description: str = ""
    headline: bool = False
    counted_by: str = ""


@dataclass(frozen=True, kw_only=True)
class RecordedDiagnostic:
    """A warning, error or note as data.

    Attributes:
        code: stable name, e.g. `scan-without-colour`.
        severity: `error`, `warning` or `note`.
        subject: the item concerned, e.g. `scan 0`.
        values: numbers and names in the text.
        text: one sentence.
        remedy: what to do; empty if nothing can be done.
        rank_by: name of the value that selects the worst of several diagnostics; the largest value
            is the worst, or the smallest if the name is prefixed with `-`.
        settled_by: methods or codes of later steps that resolve it.
        is_summary: whether it summarises the step.
    """

    code: str
    severity: Literal["error", "warning", "note"]
    subject: str
    values: Mapping[str, bool | int | float | str | None]
    text: str
    remedy: str = ""
    rank_by: str = ""
    settled_by: tuple[str, ...] = ()
    is_summary: bool = False


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Name, caption and type of a figure.

    Attributes:
        name: name given by the method.
        caption: one sentence.
        media_type: `image/png`, `image/webp` or `image/svg+xml`.
    """

    name: str
    caption: str
    media_type: str


@dataclass(frozen=True, kw_only=True)
class RecordedFigure(Figure):
    """A figure in a record.

    Attributes:
        data: bytes of the file.
    """

    data: bytes = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class ProductRef:
    """Reference to a product by its content.

    Attributes:
        type_name: product type; `files` for a workflow input.
        encoding_version: version of the type's encoding; 0 for files.
        digest: `sha256:` and 64 hexadecimal digits, of the logical content.
    """

    type_name: str
    encoding_version: int
    digest: str


@dataclass(frozen=True, kw_only=True)
class RecordedProduct(ProductRef):
    """An output or input of a cell.

    Attributes:
        source: `address.port` or `inputs.name` for inputs; empty for outputs.
        embedded: whether the arrays are in the record (outputs only).
    """

    source: str = ""
    embedded: bool = False


@dataclass(frozen=True, kw_only=True)
class RecordedFile:
    """An input file, without its folder."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedInput:
    """A workflow input; without files if it is optional and was not given.

    Attributes:
        name: name in the workflow.
        files: files sorted by name.
        embedded: whether the bytes of the files are in the record.
    """

    name: str
    files: tuple[RecordedFile, ...]
    embedded: bool = False


@dataclass(frozen=True, kw_only=True)
class PublishedFile:
    """A file that the run wrote for other programs.

    Attributes:
        path: path relative to the folder of the record, with `/` as separator.
        size_bytes: size of the file.
        sha256: SHA-256 of its bytes in hexadecimal digits.
    """

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """The environment in which a cell ran.

    Attributes:
        id: digest of the other fields; used as reference in cells.
        python: version of Python.
        os: operating system and release.
        cpu: model name of the processor.
        cores: number of logical processors.
        threads: number of threads of the cell.
        git_commit: commit of orthoflow if run from a checkout, with `+changes` if modified;
            otherwise empty.
        packages: distribution name -> version.
    """

    id: str
    python: str
    os: str
    cpu: str
    cores: int
    threads: int
    git_commit: str
    packages: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class MethodIdentity:
    """The code that computed a result.

    Attributes:
        method: method id.
        distribution: name of the distribution that contains the method.
        distribution_version: version of the distribution.
        result_version: version number of the method's results.
        determinism: exact, seeded or loose.
        citations: publications of the method.
    """

    method: str = ""
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = ""
    citations: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Cost of one execution of a method; in a record, of the run that computed the result.

    Values that were not measured are None.

    Attributes:
        wall_s: elapsed seconds of the method, without `compile_s`, or including it if `compile_s`
            is None.
        cpu_s: processor seconds of the step's process in this time, with `compile_s` treated in the
            same way, and without drawing of figures; used for rankings.
        peak_rss_mib: peak memory of the step's process.
        stored_mib: size in the store of products, published files and figures; the store keeps
            content shared by several cells only once. None also for cells without a result.
        compile_s: elapsed seconds in which the step's process loaded modules and compiled kernels,
            before, during and after the call; not used for rankings, because it depends on earlier
            steps.
    """

    wall_s: Annotated[float, Quantity(label="time", unit="s", better="lower")] = 0.0
    cpu_s: Annotated[float, Quantity(label="processor time", unit="s", better="lower")] = 0.0
    peak_rss_mib: Annotated[float, Quantity(label="memory", unit="MiB", better="lower")] = 0.0
    stored_mib: Annotated[float | None, Quantity(label="stored", unit="MiB", better="lower")] = None
    compile_s: Annotated[float | None, Quantity(label="loading and compiling", unit="s")] = None


COSTS: Final[Mapping[str, Quantity]] = {
    name: hint.__metadata__[0]
    for name, hint in typing.get_type_hints(Costs, include_extras=True).items()
}


@dataclass(frozen=True, kw_only=True)
class CellOutcome(MethodIdentity, Costs):
    """The outcome of a cell, as kept in the store and repeated in the record of a run.

    Attributes:
        status: ok, failed or skipped.
        error_type: class of the error; empty if ok; for skipped cells, `not-asked-for` if optional
            data was not given, otherwise empty.
        error_message: one sentence; for skipped cells, the reason.
        key: cache key, SHA-256 in hexadecimal digits; empty if it was never known.
        key_preimage: canonical JSON whose SHA-256 is the key.
        seed: seed of the random generator; None if the method uses none.
        started: ISO 8601, UTC; for cached cells, from the run that computed them.
        ended: ISO 8601, UTC; as `started`.
        metrics: metrics reported by the method.
        warnings: texts of the warnings, which limit the use of the result.
        diagnostics: warnings and notes as data.
        log: text of the log.
    """

    status: CellStatus
    error_type: str = ""
    error_message: str = ""
    key: str = ""
    key_preimage: str = ""
    seed: int | None = None
    started: str = ""
    ended: str = ""
    metrics: tuple[Metric, ...] = ()
    warnings: tuple[str, ...] = ()
    diagnostics: tuple[RecordedDiagnostic, ...] = ()
    log: str = ""


@dataclass(frozen=True, kw_only=True, repr=False)
class RecordedCell(CellOutcome):
    """A cell of a run: one execution of a method.

    Attributes:
        address: `step` or `step@step=variant,...`, followed by `#n` for repeats after the first.
        step: name of the step.
        assignment: step -> variant, in graph order.
        repeat: index of the repeat, 0 for the first.
        params: all parameters, resolved.
        params_set: parameters set in the workflow or on the command line, as written.
        environment: id of the environment.
        cached_from: id of the run that computed it; empty if this run did.
        figures: figures of the method.
        inputs: port -> product.
        outputs: port -> product.
    """

    address: str
    step: str
    assignment: Mapping[str, str] = field(default_factory=dict)
    repeat: int = 0
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    environment: str = ""
    cached_from: str = ""
    figures: tuple[RecordedFigure, ...] = ()
    inputs: Mapping[str, RecordedProduct] = field(default_factory=dict)
    outputs: Mapping[str, RecordedProduct] = field(default_factory=dict)

    def __repr__(self) -> str:
        # Logs and parameters are too long to print in one line.
        metrics, figures = len(self.metrics), len(self.figures)
        return (
            f"<RecordedCell {self.address!r}: {self.method}, {self.status}, {self.wall_s:.3g} s, "
            f"{metrics} metrics, {figures} figures>"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunRecord:
    """A whole record, except the arrays of products.

    Attributes:
        run_id: unique id, without further meaning.
        name: name of the workflow.
        created_by: program and version, e.g. `orthoflow 0.1.0`.
        status: `ok`, or `failed` if any cell failed.
        started: ISO 8601, UTC.
        ended: ISO 8601, UTC.
        seed: seed of the workflow.
        workflow_source: text of the workflow file.
        workflow_resolved: workflow as JSON with all overrides applied.
        overrides: `--set` and other options that changed the workflow or selected steps, as given.
        inputs: inputs of the workflow.
        environments: environments of the cells, without duplicates.
        cells: cells in the order of the graph.
        published: files next to the record, for other programs.
    """

    run_id: str
    name: str
    created_by: str
    status: Literal["ok", "failed"]
    started: str
    ended: str
    seed: int
    workflow_source: str
    workflow_resolved: str
    overrides: tuple[str, ...] = ()
    inputs: tuple[RecordedInput, ...] = ()
    environments: tuple[RecordedEnvironment, ...] = ()
    cells: tuple[RecordedCell, ...] = ()
    published: tuple[PublishedFile, ...] = ()

    def __repr__(self) -> str:
        return (
            f"<RunRecord {self.run_id!r} of {self.name!r}: {self.status}, started {self.started}, "
            f"{len(self.cells)} cells>"
        )


def cost_metrics(costs: Costs) -> tuple[Metric, ...]:
    """Return the measured costs as metrics, in the order of the fields."""
    measured = {name: getattr(costs, name) for name in COSTS}
    return tuple(
        Metric(
            name=name,
            value=float(value),
            unit=COSTS[name].unit,
            label=COSTS[name].label,
            better=COSTS[name].better,
        )
        for name, value in measured.items()
        if value is not None
    )


# `Any`: keyword arguments of a constructor with annotated parameters.
def shared_fields(source: object, part: type) -> dict[str, Any]:
    """Return the fields of an object that belong to one of its base classes, as keywords."""
    return {item.name: getattr(source, item.name) for item in fields(part)}


def to_json(record: RunRecord) -> dict[str, Any]:
    """Return the document of a record: one object per dataclass, with digests instead of bytes.

    Raises:
        RecordFormatError: the record contains values that JSON cannot represent.
    """

    def digested(figure: RecordedFigure) -> RecordedFigure:
        return replace(figure, data=hashlib.sha256(figure.data).hexdigest().encode())

    try:
        document: dict[str, Any] = _codec().dump_python(
            _with_figures(record, digested), mode="json"
        )
    except ValueError as error:
        raise RecordFormatError(f"the record cannot be written as JSON: {error}") from error
    plain_json(document)
    return document


def from_json(text: str, contents: Callable[[str], bytes]) -> RunRecord:
    """Read a document.

    Args:
        text: JSON text of a document from `to_json`.
        contents: SHA-256 -> bytes, for bytes that were replaced by digests.

    Raises:
        RecordFormatError: the text is not JSON, or a field is missing, unknown, or has another
            type.
    """
    document = parse_json(text, "the document")
    codec = _codec()
    from pydantic import ValidationError  # noqa: PLC0415 - as above

    try:
        record = codec.validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = "/".join(map(str, first["loc"]))
        raise RecordFormatError(f"the document at /{place}: {first['msg']}") from error
    if codec.dump_python(record, mode="json") != document:
        raise RecordFormatError("the document lacks a field, or contains one that is not allowed")
    return _with_figures(record, lambda one: replace(one, data=contents(one.data.decode())))


def _with_figures(
    record: RunRecord, change: Callable[[RecordedFigure], RecordedFigure]
) -> RunRecord:
    cells = (replace(cell, figures=tuple(map(change, cell.figures))) for cell in record.cells)
    return replace(record, cells=tuple(cells))


@cache
def _codec() -> TypeAdapter[RunRecord]:
    from pydantic import TypeAdapter  # noqa: PLC0415 - `orthoflow --help` needs none

    return TypeAdapter(RunRecord)


def parse_json(text: str, place: str) -> JsonValue:
    """Parse strict JSON: without NaN, infinity and excessive nesting.

    Raises:
        RecordFormatError: the text is not valid JSON in this sense.
    """

    def refuse(constant: str) -> JsonValue:
        raise ValueError(f"{constant} is not valid JSON")

    try:
        value: JsonValue = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise RecordFormatError(f"{place} must contain JSON: {error}") from error
    return value


def canonical_json(value: object) -> str:
    """Return the canonical JSON text of a value, for digests.

    Keys are sorted by code point; there is no white space, no escapes beyond those required by
    JSON, and floats have the shortest digits that restore them. `1`, `1.0` and `-0.0` remain
    distinct, as do `true` and `1`.

    Raises:
        RecordFormatError: the value contains NaN, infinity, keys that are not text, unpaired
            surrogates, or a type that is not JSON.

    >>> canonical_json({"b": 1.0, "a": [True, None, "é"]})
    '{"a":[true,null,"é"],"b":1.0}'
    """
    text = json.dumps(
        plain_json(value),
        sort_keys=True,
        ensure_ascii=False,
        allow_nan=False,
        separators=(",", ":"),
    )
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise RecordFormatError(
            f"text must be valid Unicode to be stored, got half a surrogate pair ({error})"
        ) from error
    return text


def sha256_text(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8 as 64 hexadecimal digits."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def plain_json(value: object, place: str = "") -> JsonValue:
    """Copy a value as plain JSON types, since subclasses could print themselves differently.

    Raises:
        RecordFormatError: the value contains NaN, infinity, keys that are not text, or a type that
            is not JSON.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordFormatError(
                f"numbers in JSON must be finite, got {value} at {place or 'root'}"
            )
        return float(value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, list | tuple):
        return [plain_json(item, f"{place}/{index}") for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise RecordFormatError(
                    f"keys of a JSON object must be text, got {key!r} at {place or 'root'}"
                )
        return {str(key): plain_json(item, f"{place}/{key}") for key, item in value.items()}
    raise RecordFormatError(
        f"JSON does not support {type(value).__name__}, found at {place or 'root'}: store "
        "numbers, text, lists or mappings"
    )
