"""The result of a finished cell, and its form in the store: the link to journal and record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Literal

from orthoflow_provenance.document import (
    CellOutcome,
    CellStatus,
    Costs,
    Figure,
    MethodIdentity,
    Metric,
    ProductRef,
    RecordedEnvironment,
    RecordedFile,
    canonical_json,
    shared_fields,
)
from orthoflow_provenance.paths import name_problem
from pydantic import TypeAdapter, ValidationError

from orthoflow.engine.durability import is_checked, with_digest
from orthoflow.errors import StoreError

# The words of a record, for the rest of the engine.
__all__ = [
    "CellOutcome",
    "CellResult",
    "CellStatus",
    "Costs",
    "Figure",
    "FigureRef",
    "MethodIdentity",
    "Metric",
    "ProductRef",
    "ProductTarget",
    "RecordedEnvironment",
    "RecordedFile",
    "canonical_json",
    "name_problem",
    "result_from_json",
    "result_to_json",
    "shared_fields",
]


@dataclass(frozen=True, kw_only=True)
class ProductTarget:
    """A product type by import strings.

    Attributes:
        type_name: its name.
        target: its class.
        publisher: writes its published files; empty without any.
        publisher_tag: version of the publisher.
    """

    type_name: str
    target: str
    publisher: str = ""
    publisher_tag: str = ""


@dataclass(frozen=True, kw_only=True)
class FigureRef(Figure):
    """A picture in the store.

    Attributes:
        sha256: digest of the bytes, hexadecimal; the store's object of that name holds them.
    """

    sha256: str


@dataclass(frozen=True, kw_only=True)
class CellResult(CellOutcome):
    """The outcome of one cell.

    Attributes:
        format: name and version of its form in the store.
        run_id: the run that computed it.
        environment: where it was computed, None if it never was.
        inputs: port -> product.
        outputs: port -> product.
        figures: pictures.
        is_bug: the method raised none of our errors: its log has the traceback.
        exit_code: of the error class, 0 when ok.
    """

    format: Literal["orthoflow/result/1"] = "orthoflow/result/1"
    run_id: str = ""
    environment: RecordedEnvironment | None = None
    inputs: Mapping[str, ProductRef] = field(default_factory=dict)
    outputs: Mapping[str, ProductRef] = field(default_factory=dict)
    figures: tuple[FigureRef, ...] = ()
    is_bug: bool = False
    exit_code: int = 0

    @property
    def objects(self) -> frozenset[str]:
        """Return names of the store's objects that it refers to: products and figures."""
        products = {ref.digest.removeprefix("sha256:") for ref in self.outputs.values()}
        return frozenset(products | {figure.sha256 for figure in self.figures})


def result_to_json(result: CellResult) -> str:
    """Return a result as JSON text."""
    return with_digest(_codec().dump_json(result).decode())


def result_from_json(text: str, where: str) -> CellResult:
    """Read a result from JSON text.

    Args:
        text: from `result_to_json`.
        where: name of the file, for the error message.

    Raises:
        StoreError: the text is damaged or of another format.
    """
    if not is_checked(text):
        raise StoreError(f"{where} is damaged: its content does not match its digest")
    try:
        return _codec().validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise StoreError(f"{where} is of another version: {place}: {first['msg']}") from error


@cache
def _codec() -> TypeAdapter[CellResult]:
    return TypeAdapter(CellResult)
