"""What a finished cell leaves behind, as JSON: the link between store, journal and record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from orthoflow.products.product import JsonValue


@dataclass(frozen=True, kw_only=True)
class ProductRef:
    """A product by its content.

    Attributes:
        type_name: product type, `files` for a workflow input.
        encoding_version: version of the type's layout, 0 for files.
        digest: `sha256:` + 64 hexadecimal digits.
    """

    type_name: str
    encoding_version: int
    digest: str


@dataclass(frozen=True, kw_only=True)
class FigureRef:
    """A picture in the store.

    Attributes:
        name: name the method gave.
        caption: one sentence.
        media_type: `image/png`, `image/webp` or `image/svg+xml`.
        sha256: digest of the bytes, hexadecimal; the store's object of that name holds them.
    """

    name: str
    caption: str
    media_type: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class MetricValue:
    """One number with its unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class CellResult:
    """The outcome of one cell.

    Attributes:
        status: ok, failed or skipped.
        key: cache key, empty when it was never known.
        key_preimage: canonical JSON the key is the SHA-256 of.
        run_id: the run that computed it.
        method: method id.
        distribution: name of the distribution that brought the method.
        distribution_version: its version.
        result_version: the method's own counter.
        determinism: exact, seeded or loose.
        citations: where the method comes from.
        seed: seed the generator was made from, None when not part of the key.
        started: ISO 8601 UTC.
        ended: ISO 8601 UTC.
        wall_s: seconds on the clock.
        cpu_s: processor seconds of the step's process.
        peak_rss_mib: largest memory of the step's process.
        environment: the environment, as `RecordedEnvironment` has it, JSON.
        inputs: port -> product.
        outputs: port -> product.
        metrics: what the method reported.
        figures: pictures.
        warnings: what limits the result.
        log: text.
        error_type: class name of the error, empty when ok.
        error_message: one sentence, or the reason why the cell was skipped.
        traceback: for `--debug` and bug reports, empty when ok.
        exit_code: of the error class, 0 when ok.
    """

    status: Literal["ok", "failed", "skipped"]
    key: str = ""
    key_preimage: str = ""
    run_id: str = ""
    method: str = ""
    distribution: str = ""
    distribution_version: str = ""
    result_version: int = 0
    determinism: str = ""
    citations: tuple[str, ...] = ()
    seed: int | None = None
    started: str = ""
    ended: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss_mib: float = 0.0
    environment: Mapping[str, JsonValue] = field(default_factory=dict)
    inputs: Mapping[str, ProductRef] = field(default_factory=dict)
    outputs: Mapping[str, ProductRef] = field(default_factory=dict)
    metrics: tuple[MetricValue, ...] = ()
    figures: tuple[FigureRef, ...] = ()
    warnings: tuple[str, ...] = ()
    log: str = ""
    error_type: str = ""
    error_message: str = ""
    traceback: str = ""
    exit_code: int = 0
