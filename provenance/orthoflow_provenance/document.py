"""The content of a record, as dataclasses and as a JSON document.

Metrics, figures, cells and records are declared only here. Methods, the store and the record use
these types or derive types with additional fields. Pydantic reads and writes all fields of the
dataclasses, so a field that is added here is also recorded, and a new field of `Costs` is also
displayed.
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

# Suffixes of figure files, by media type; other media types are not allowed.
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
    # The type is Any, because Pydantic cannot resolve a recursive alias. Other code checks that
    # values are JSON.
    JsonValue = Any
CellStatus = Literal["ok", "failed", "skipped"]


class RecordFormatError(ValueError):
    """A file or value does not conform to the record format: it is damaged, invalid or incomplete.

    The message states what was found, what was expected and where, and how to fix it if possible.
    """


class UnknownFormatError(RecordFormatError):
    """The file has another format or format version, so it cannot be checked."""


class LockedFileError(RecordFormatError):
    """The file is open for writing in another process, or was not closed because of a crash."""


class InputFileError(RecordFormatError):
    """An input file to embed is missing, or was changed after its digest had been computed."""


class UnsafeFileError(RecordFormatError):
    """A path leads out of its folder, or does not lead to a regular file."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Label and unit of a measured quantity, and whether lower or higher values are better.

    Attributes:
        label: name in tables, without unit.
        unit: unit, as in `Metric`.
        better: values that are better, as in `Metric`.
    """

    label: str
    unit: str
    better: str = ""


class PayloadLike(Protocol):
    """A product as named arrays and JSON; `orthoflow.products.Payload` is an example."""

    @property
    def type_name(self) -> str:
        """Name of the product type."""

    @property
    def encoding_version(self) -> int:
        """Version of the type's encoding."""

    @property
    def metadata(self) -> Mapping[str, JsonValue]:
        """JSON object with everything that is not an array."""

    @property
    def arrays(self) -> Mapping[str, NDArray[np.generic]]:
        """Arrays by name; names may contain `/`."""

    @property
    def mapped(self) -> bool:
        """Whether arrays are stored contiguously and uncompressed."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A measured number with its unit.

    Attributes:
        name: name of the metric; it ends with the unit if there is one.
        value: finite number.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares.
        label: name in tables if the method declares one; otherwise empty.
        better: values that are better: `lower`, `higher` or `one` (closest to 1); empty if no
            values are better.
        description: additional explanation, one sentence.
        headline: whether the metric describes the quality of the result.
        counted_by: name of the metric of the same step that contains the number of summarised
            items. Values for different numbers of items are not comparable.
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
    """A warning, error or note, including the data from which its text was formatted.

    Attributes:
        code: stable name, such as `scan-without-colour`.
        severity: `error`, `warning` or `note`.
        subject: the affected item, such as `scan 0`.
        values: numbers and names that are used in the text.
        text: description of the problem, one sentence.
        remedy: what the user can do; empty if nothing.
        rank_by: name of the value that determines the worst of several diagnostics. The largest
            value is the worst, or the smallest if the name has the prefix `-`.
        settled_by: methods of later steps, or codes of their diagnostics, that make this diagnostic
            obsolete.
        is_summary: whether the diagnostic summarises the step.
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
    """Name, caption and media type of a figure.

    Attributes:
        name: name that the method gives to the figure.
        caption: caption, one sentence.
        media_type: `image/png`, `image/webp` or `image/svg+xml`.
    """

    name: str
    caption: str
    media_type: str


@dataclass(frozen=True, kw_only=True)
class RecordedFigure(Figure):
    """A figure in a record.

    Attributes:
        data: bytes of the image file.
    """

    data: bytes = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class ProductRef:
    """Reference to a product, or to the files of a workflow input, by the digest of the content.

    Attributes:
        type_name: name of the product type; `files` for a workflow input.
        encoding_version: version of the type's encoding; 0 for files.
        digest: digest of the content: `sha256:`, followed by 64 hexadecimal digits.
    """

    type_name: str
    encoding_version: int
    digest: str


@dataclass(frozen=True, kw_only=True)
class RecordedProduct(ProductRef):
    """An output or input of a cell.

    Attributes:
        source: source of an input, `address.port` or `inputs.name`; empty for outputs.
        embedded: whether the arrays are in the record; only for outputs.
    """

    source: str = ""
    embedded: bool = False


@dataclass(frozen=True, kw_only=True)
class RecordedFile:
    """An input file; its folder is not recorded."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedInput:
    """A workflow input. It has no files if it is optional and was not given.

    Attributes:
        name: name of the input in the workflow.
        files: files, sorted by name.
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
        sha256: SHA-256 of the file in hexadecimal digits.
    """

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """The environment in which a cell ran.

    Attributes:
        id: digest of the other fields, to which cells refer.
        python: version of Python.
        os: operating system and release.
        cpu: model name of the processor.
        cores: number of logical processors.
        threads: number of threads that the cell was allowed to use.
        git_commit: commit of orthoflow, followed by `+changes` if files were modified; empty if
            orthoflow was not run from a checkout.
        packages: versions of the installed distributions, by name.
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
        method: id of the method.
        distribution: name of the distribution that contains the method.
        distribution_version: version of the distribution.
        result_version: version number of the method's results.
        determinism: `exact`, `seeded` or `loose`.
        citations: publications that describe the method.
    """

    method: str = ""
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = ""
    citations: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Cost of an execution of a method, in the run that computed the result.

    Values that were not measured are None.

    Attributes:
        wall_s: elapsed seconds of the method, excluding `compile_s`. If `compile_s` is None, the
            time for loading and compiling is included.
        cpu_s: processor seconds of the step's process during the method, excluding loading and
            compiling as in `wall_s`, and excluding the drawing of figures; used for rankings.
        peak_rss_mib: peak memory of the step's process.
        stored_mib: size of products, published files and figures in the store. The store contains
            the content shared by several cells only once. None also for cells without a result.
        compile_s: elapsed seconds for loading modules and compiling kernels in the step's process,
            before, during and after the execution; not used for rankings, because it depends on
            earlier steps.
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
    """The outcome of a cell, as in the store and in the record of a run.

    Attributes:
        status: `ok`, `failed` or `skipped`.
        error_type: class of the error if the cell failed; `not-asked-for` if the cell was skipped
            because optional data was not given; otherwise empty.
        error_message: description of the error, or the reason why the cell was skipped; one
            sentence.
        key: cache key, a SHA-256 in hexadecimal digits; empty if it was never computed.
        key_preimage: canonical JSON text whose SHA-256 is the key.
        seed: seed of the random generator; None if the method uses none.
        started: start time, ISO 8601 in UTC; for cached cells, that of the run that computed them.
        ended: end time, ISO 8601 in UTC; for cached cells, that of the run that computed them.
        metrics: metrics reported by the method.
        warnings: texts of the warnings about limitations of the result.
        diagnostics: warnings, errors and notes, including their data.
        log: log of the cell.
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
        address: `step` or `step@step=variant,...`, followed by `#n` for all repeats except the
            first.
        step: name of the step.
        assignment: variants by step, in the order of the graph.
        repeat: index of the repeat; 0 for the first.
        params: all parameters of the method, including default values.
        params_set: parameters that were set in the workflow or on the command line, with the values
            as written.
        environment: id of the environment.
        cached_from: id of the run that computed the cell; empty if it is this run.
        figures: figures that the method drew.
        inputs: input products by port.
        outputs: output products by port.
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
        # Omit logs and parameters, which are too long for one line.
        metrics, figures = len(self.metrics), len(self.figures)
        return (
            f"<RecordedCell {self.address!r}: {self.method}, {self.status}, {self.wall_s:.3g} s, "
            f"{metrics} metrics, {figures} figures>"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunRecord:
    """The content of a record, except the arrays of products.

    Attributes:
        run_id: unique id; it contains no other information.
        name: name of the workflow.
        created_by: program and version, such as `orthoflow 0.1.0`.
        status: `ok`, or `failed` if any cell failed.
        started: start time, ISO 8601 in UTC.
        ended: end time, ISO 8601 in UTC.
        seed: seed of the workflow.
        workflow_source: text of the workflow file.
        workflow_resolved: workflow as JSON, after all overrides.
        overrides: `--set` and other options that changed the workflow or selected steps, as given
            on the command line.
        inputs: inputs of the workflow.
        environments: the different environments of the cells.
        cells: cells in the order of the graph.
        published: files that the run wrote for other programs, next to the record.
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


# The type is Any, because the values are passed as keyword arguments to constructors whose
# parameters have different types.
def shared_fields(source: object, part: type) -> dict[str, Any]:
    """Return the fields that an object inherits from a base class, as keyword arguments."""
    return {item.name: getattr(source, item.name) for item in fields(part)}


def to_json(record: RunRecord) -> dict[str, Any]:
    """Return the document of a record: an object for each dataclass, with digests instead of bytes.

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
    """Read a record from its document.

    Args:
        text: JSON text of a document from `to_json`.
        contents: the bytes that the document replaces by digests, by their SHA-256.

    Raises:
        RecordFormatError: the text is not JSON, or a field is missing, unknown or of another type.
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
    """Parse strict JSON, in which NaN, infinity and deep nesting are not allowed.

    Raises:
        RecordFormatError: the text is not strict JSON.
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

    Keys are sorted by code point. There is no white space, only characters that JSON requires to be
    escaped are escaped, and floats have the fewest digits from which they can be restored. `1`,
    `1.0` and `-0.0` remain distinct, and so do `true` and `1`.

    Raises:
        RecordFormatError: the value contains NaN, infinity, keys that are not strings, unpaired
            surrogates, or types that JSON does not have.

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
            f"text must be valid Unicode to be stored, got an unpaired surrogate ({error})"
        ) from error
    return text


def sha256_text(text: str) -> str:
    """Return the SHA-256 of a string, encoded in UTF-8, as 64 hexadecimal digits."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def plain_json(value: object, place: str = "") -> JsonValue:
    """Copy a value as basic JSON types, since subclasses could be formatted differently.

    Raises:
        RecordFormatError: the value contains NaN, infinity, keys that are not strings, or types
            that JSON does not have.
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
