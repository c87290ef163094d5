"""What a record says, as plain dataclasses: the writer takes them, the reader gives them back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

JsonValue: TypeAlias = bool | int | float | str | list["JsonValue"] | dict[str, "JsonValue"] | None
CellStatus = Literal["ok", "failed", "skipped"]


class PayloadLike(Protocol):
    """A product as named arrays and JSON; `orthoflow.products.Payload` is one."""

    @property
    def type_name(self) -> str:
        """Name of the product type."""
        raise AssertionError("a protocol is never called")

    @property
    def encoding_version(self) -> int:
        """Version of the type's layout."""
        raise AssertionError("a protocol is never called")

    @property
    def metadata(self) -> Mapping[str, JsonValue]:
        """Everything that is not an array."""
        raise AssertionError("a protocol is never called")

    @property
    def arrays(self) -> Mapping[str, NDArray[np.generic]]:
        """Arrays by name; names may have `/`."""
        raise AssertionError("a protocol is never called")

    @property
    def mapped(self) -> bool:
        """Store contiguous and uncompressed."""
        raise AssertionError("a protocol is never called")


@dataclass(frozen=True, kw_only=True)
class RecordedMetric:
    """One number with its unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class RecordedFigure:
    """One picture, the bytes of a PNG or SVG file."""

    name: str
    caption: str
    media_type: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class RecordedProduct:
    """One output or input of a cell.

    Attributes:
        type_name: product type, `files` for a workflow input.
        encoding_version: version of the type's layout, 0 for files.
        digest: `sha256:` + 64 hexadecimal digits of the logical content.
        source: for inputs `address.port` or `inputs.name`; empty for outputs.
        embedded: the arrays are in the record (outputs only).
    """

    type_name: str
    encoding_version: int
    digest: str
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
class RecordedCell:
    """One cell of a run: a method applied once.

    Attributes:
        address: `step` or `step@step=variant,...`, `#n` behind it for repeats after the first.
        step: name of the step.
        assignment: step -> variant, in graph order.
        repeat: 0 for the first.
        method: method id.
        distribution: name of the distribution that brought the method.
        distribution_version: its version.
        result_version: the method's own counter.
        determinism: exact, seeded or loose.
        status: ok, failed or skipped.
        error_type: class of the error, empty when ok; for skipped cells empty too.
        error_message: one sentence; for skipped cells the reason.
        params: all parameters, resolved.
        params_set: parameters as written, and from the command line.
        key: cache key, SHA-256 in hexadecimal digits; empty when never known.
        key_preimage: canonical JSON the key is the digest of.
        seed: seed the generator was made from, None when the method uses none.
        started: ISO 8601 UTC; of the original run for cached cells.
        ended: likewise.
        wall_s: seconds on the clock, of the original run for cached cells.
        cpu_s: processor seconds.
        peak_rss_mib: largest memory of the step's process.
        environment: id of the environment.
        cached_from: run id of the run that computed it; empty when computed in this run.
        metrics: what the method reported.
        figures: pictures.
        warnings: what limits the result.
        citations: where the method comes from.
        log: text.
        inputs: port -> product.
        outputs: port -> product.
    """

    address: str
    step: str
    method: str
    status: CellStatus
    assignment: Mapping[str, str] = field(default_factory=dict)
    repeat: int = 0
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = ""
    error_type: str = ""
    error_message: str = ""
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    key: str = ""
    key_preimage: str = ""
    seed: int | None = None
    started: str = ""
    ended: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss_mib: float = 0.0
    environment: str = ""
    cached_from: str = ""
    metrics: tuple[RecordedMetric, ...] = ()
    figures: tuple[RecordedFigure, ...] = ()
    warnings: tuple[str, ...] = ()
    citations: tuple[str, ...] = ()
    log: str = ""
    inputs: Mapping[str, RecordedProduct] = field(default_factory=dict)
    outputs: Mapping[str, RecordedProduct] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
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
        overrides: `--set` and other options that changed the workflow, as given.
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
