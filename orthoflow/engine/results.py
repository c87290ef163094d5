"""The result of a finished cell, and its JSON form in the store."""

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

# Some of these names are re-exported from the record format.
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
    """A product type as import strings.

    Attributes:
        type_name: name of the type.
        target: class of the product.
        publisher: function that writes its published files; empty if there is none.
    """

    type_name: str
    target: str
    publisher: str = ""


@dataclass(frozen=True, kw_only=True)
class FigureRef(Figure):
    """A figure in the store.

    Attributes:
        sha256: SHA-256 of the bytes as hexadecimal digits, which is also the name of the object in
            the store.
    """

    sha256: str


@dataclass(frozen=True, kw_only=True)
class CellResult(CellOutcome):
    """The result of one cell.

    Attributes:
        format: name and version of the JSON format.
        run_id: id of the run that computed the result.
        environment: environment in which the result was computed; None for a skipped cell.
        inputs: port -> product.
        outputs: port -> product.
        figures: figures drawn by the method.
        is_bug: whether the method raised an unexpected exception; the log contains the traceback.
        exit_code: exit code of the error class, 0 if ok.
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
        """Return the names of the objects to which the result refers: products and figures."""
        products = {ref.digest.removeprefix("sha256:") for ref in self.outputs.values()}
        return frozenset(products | {figure.sha256 for figure in self.figures})


def result_to_json(result: CellResult) -> str:
    """Return a result as JSON text."""
    return with_digest(_codec().dump_json(result).decode())


def result_from_json(text: str, where: str) -> CellResult:
    """Read a result from JSON text.

    Args:
        text: text from `result_to_json`.
        where: name of the file, for the error message.

    Raises:
        StoreError: the text is damaged or has another format.
    """
    if not is_checked(text):
        raise StoreError(f"{where} is damaged: its content does not match its digest")
    try:
        return _codec().validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise StoreError(f"{where} has an unsupported format: {place}: {first['msg']}") from error


@cache
def _codec() -> TypeAdapter[CellResult]:
    return TypeAdapter(CellResult)
