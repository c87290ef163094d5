"""Cell results as JSON text and back, the form in which the store keeps them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, cast

from orthoflow.engine.results import CellResult, FigureRef, MetricValue, ProductRef
from orthoflow.errors import StoreError

FORMAT = "orthoflow/result/1"


def result_to_json(result: CellResult) -> str:
    """Give a result as JSON text."""
    content = dataclasses.asdict(result)
    content["environment"] = dict(result.environment)
    return json.dumps({"format": FORMAT} | content, allow_nan=False, ensure_ascii=False)


def result_from_json(text: str, where: str) -> CellResult:
    """Read a result from JSON text.

    Args:
        text: what `result_to_json` gave.
        where: name of the file, for the error message.

    Raises:
        StoreError: the text is damaged or of another format.
    """
    try:
        content = json.loads(text)
        if content.pop("format") != FORMAT:
            raise StoreError(f"{where} has a result format that this orthoflow cannot read")
        return _decode(content)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{where} is damaged: {error}") from error


def product_refs(stored: Mapping[str, Mapping[str, Any]]) -> dict[str, ProductRef]:
    """Read references to products by port, as JSON has them."""
    return {port: ProductRef(**ref) for port, ref in stored.items()}


def _decode(content: dict[str, Any]) -> CellResult:
    values = content | {
        "citations": tuple(content["citations"]),
        "warnings": tuple(content["warnings"]),
        "inputs": product_refs(content["inputs"]),
        "outputs": product_refs(content["outputs"]),
        "metrics": tuple(MetricValue(**metric) for metric in content["metrics"]),
        "figures": tuple(FigureRef(**figure) for figure in content["figures"]),
    }
    return CellResult(**cast("Any", values))
