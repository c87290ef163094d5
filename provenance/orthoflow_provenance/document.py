"""The content of a record, as dataclasses and as one JSON document.

The only declaration of metric, figure, cell and record: methods, store and record use these types,
or add to them what only they know. Pydantic reads and writes the document by the fields, so a field
that is added here is recorded, and those of `Costs` are shown wherever the others are.
"""

from __future__ import annotations

import hashlib
import json
import math
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
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

# What a figure may be, and what its file is called.
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
    # Pydantic cannot resolve an alias that contains itself; the document is JSON already.
    JsonValue = Any
CellStatus = Literal["ok", "failed", "skipped"]


class RecordFormatError(ValueError):
    """A file or a value does not fit the record format: damaged, forbidden or incomplete.

    The message is one sentence: what was found, what was expected, where, and the way out if there
    is one.
    """


class UnknownFormatError(RecordFormatError):
    """The file is of another program, or of another version of the format: it cannot be checked."""


class LockedFileError(RecordFormatError):
    """The file is open for writing elsewhere, or was left so by a program that crashed."""


class InputFileError(RecordFormatError):
    """An input file that is to be embedded is missing, or not the one that was digested."""


class UnsafeFileError(RecordFormatError):
    """A name leads elsewhere than to a file in its folder, or no regular file stands there."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Label, unit and direction of a measured number.

    Attributes:
        label: what tables call it, beside its unit.
        unit: as in metrics.
        better: likewise.
    """

    label: str
    unit: str
    better: str = ""


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
        label: what tables call it, where its method declares that; empty without.
        better: which values are better, `lower`, `higher` or `one`; empty where none are.
        description: what else to know of it, one sentence.
        headline: it is one of the numbers that state how good a result is.
        counted_by: metric of the same step with the number of items it summarises; values over
            unequal numbers of them are not comparable.
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
        is_summary: it sums up what the step did.
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
    """Name, caption and type of a picture.

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

    name: str
    files: tuple[RecordedFile, ...]
    embedded: bool = False


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

    What was not measured is None.

    Attributes:
        wall_s: seconds on the clock that the method ran, without `compile_s`; with it where
            `compile_s` is None.
        cpu_s: processor seconds of the step's process meanwhile, likewise and without drawing
            figures: rankings use it.
        peak_rss_mib: largest memory of the step's process.
        stored_mib: what its products, their published files and its figures take in the store;
            equal ones of several cells lie there once. None for cells without a result too.
        compile_s: seconds on the clock that the step's process loaded modules and compiled kernels,
            before, in and after the call. It depends on earlier steps, so nothing is ranked by it.
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
    """What a cell came to: the store keeps it, and the record of a run repeats it.

    Attributes:
        status: ok, failed or skipped.
        error_type: class of the error, empty when ok; of skipped cells `not-asked-for` where
            optional data decide, else empty.
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
        # Logs and lists of parameters are too long for a line.
        metrics, figures = len(self.metrics), len(self.figures)
        return (
            f"<RecordedCell {self.address!r}: {self.method}, {self.status}, {self.wall_s:.3g} s, "
            f"{metrics} metrics, {figures} figures>"
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class RunRecord:
    """The whole record except the products' arrays.

    Attributes:
        run_id: opaque, unique.
        name: name of the workflow.
        created_by: program and version, e.g. `orthoflow 0.1.0`.
        status: ok, or failed when some cell failed.
        started: ISO 8601 UTC.
        ended: ISO 8601 UTC.
        seed: seed of the workflow.
        workflow_source: the file as written.
        workflow_resolved: JSON of the workflow with all overrides applied.
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
    """Return what was measured as metrics, in the order of the fields, without what was not."""
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


# Any: keywords for a constructor, whose own annotations state their types.
def shared_fields(source: object, part: type) -> dict[str, Any]:
    """Return the fields of an object that belong to one of its base classes, as keywords."""
    return {item.name: getattr(source, item.name) for item in fields(part)}


def to_json(record: RunRecord) -> dict[str, Any]:
    """Return the document of a record: an object per dataclass, digests in the place of bytes.

    Raises:
        RecordFormatError: it holds what cannot be JSON.
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
        text: JSON of what `to_json` returned.
        contents: SHA-256 -> bytes, for what was written as digest.

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
    if (written := codec.dump_python(record, mode="json")) != document:
        odd = min({*_paths(document)} ^ {*_paths(written)}, default="/")
        raise RecordFormatError(f"the document lacks {odd}, or has it where no such field is known")
    return _with_figures(record, lambda one: replace(one, data=contents(one.data.decode())))


def _with_figures(
    record: RunRecord, change: Callable[[RecordedFigure], RecordedFigure]
) -> RunRecord:
    cells = (replace(cell, figures=tuple(map(change, cell.figures))) for cell in record.cells)
    return replace(record, cells=tuple(cells))


def _paths(value: JsonValue, place: str = "") -> Iterator[str]:
    """Yield the paths of all values in a document."""
    below: Iterable[tuple[object, JsonValue]] = ()
    if isinstance(value, dict):
        below = value.items()
    elif isinstance(value, list):
        below = enumerate(value)
    for name, item in below:
        yield f"{place}/{name}"
        yield from _paths(item, f"{place}/{name}")


@cache
def _codec() -> TypeAdapter[RunRecord]:
    from pydantic import TypeAdapter  # noqa: PLC0415 - `orthoflow --help` needs none

    return TypeAdapter(RunRecord)


def parse_json(text: str, place: str) -> JsonValue:
    """Parse JSON as the format understands it: no NaN, no infinity, no endless nesting.

    Raises:
        RecordFormatError: the text is not such JSON.
    """

    def refuse(constant: str) -> JsonValue:
        raise ValueError(f"{constant} is not valid JSON")

    try:
        value: JsonValue = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise RecordFormatError(f"{place} must hold JSON: {error}") from error
    return value


def canonical_json(value: object) -> str:
    """Write a JSON value in the one way that digests are made of.

    Keys sorted by code point, no white space, no escapes beyond JSON's own, the shortest digits
    that give the same float. `1`, `1.0` and `-0.0` stay apart, as do `true` and `1`.

    Raises:
        RecordFormatError: the value holds NaN, infinity, keys that are not text, half a surrogate
            pair, or anything that is not JSON.

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
    """Digest of a text's UTF-8 bytes, 64 hexadecimal digits."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def plain_json(value: object, place: str = "") -> JsonValue:
    """Copy a value as plain JSON types, so that subclasses cannot print themselves differently.

    Raises:
        RecordFormatError: the value holds NaN, infinity, keys that are not text, or what is no
            JSON.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RecordFormatError(f"JSON needs finite numbers, got {value} at {place or 'root'}")
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
        f"JSON knows no {type(value).__name__}, got one at {place or 'root'}: store numbers, text, "
        "lists or mappings"
    )
