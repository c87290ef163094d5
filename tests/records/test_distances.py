"""How far two products lie apart: by unit, within what their type allows, and what is unsaid."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from orthoflow.errors import PluginError
from orthoflow.products.product import Payload, Tolerance
from orthoflow.records.compare import ProductDistance, RunProducts, product_distances
from tests.report_runs import HeldRun, cell, given, record


def payload(**arrays: Any) -> Payload:
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    return Payload(type_name="toy", encoding_version=1, metadata={}, arrays=arrays)


class Toy:
    """A product type of which fields may differ."""

    encoding_version: ClassVar[int] = 1
    tolerances: ClassVar[dict[str, Tolerance]] = {
        "depth_m": Tolerance(limit=0.001, unit="m"),
        "rgb": Tolerance(limit=2, unit="grey"),
        "n": Tolerance(limit=0, unit="1"),
    }


class Catalog:
    def product_class(self, name: str) -> Any:
        if name != "toy":
            raise PluginError(f"no product type {name}")
        return Toy


def compared(left: Payload, right: Payload | None, *, kind: str = "toy") -> ProductDistance:
    sides = []
    for one in (left, right):
        out = replace(given("", "0", kind), digest=f"{id(one)}", embedded=one is not None)
        held: Any = {("cell", "out"): SimpleNamespace(to_payload=partial(copy, one))}
        made = record([cell("cell", outputs={"out": out})])
        sides.append(RunProducts(run=HeldRun(path=Path("run.h5"), record=made, products=held)))
    (found,) = product_distances(*sides, ["cell"], Catalog())  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize(
    ("apart", "verdict", "n_values"), [(0.0009, "within tolerance", 0), (0.0011, "different", 2)]
)
def test_values_may_lie_apart_as_their_type_allows(
    apart: float, verdict: str, n_values: int
) -> None:
    before = payload(depth_m=np.array([1.0, 2.0, 3.0]), n=[1, 2])
    after = payload(depth_m=np.array([1.0, 2.0 + apart, 3.0 - apart]), n=[1, 2])
    found = compared(before, after)
    assert found.verdict == verdict
    (distance,) = found.distances
    assert (distance.unit, distance.field, distance.n_values) == ("m", "depth_m", n_values)
    assert distance.largest == pytest.approx(apart)
    assert distance.limit == 0.001
    assert (found.reason == "") is (n_values == 0)


def test_a_number_and_no_number_have_no_difference() -> None:
    found = compared(payload(depth_m=[np.nan, 1.0]), payload(depth_m=[1.0, 1.5]))
    (distance,) = found.distances
    assert (found.verdict, distance.largest, distance.n_values) == ("different", None, 2)


def test_what_cannot_be_had_is_not_measured() -> None:
    found = compared(payload(n=[1]), None)
    assert found.verdict == "not measured"
    assert "no record or available store" in found.reason
    found = compared(payload(n=[1]), payload(n=[1]), kind="strange")
    assert found.verdict == "not measured"
    assert (
        found.reason
        == "the digests differ, but the arrays cannot be compared: no product type strange"
    )


@pytest.mark.parametrize(
    ("dtype", "limit"), [(np.uint8, 2.0), (np.uint16, 2.0 * 257), (np.int32, 2.0)]
)
def test_grey_of_sixteen_bits_counts_in_steps_of_257(dtype: Any, limit: float) -> None:
    for field, allowed in (("rgb", limit), ("n", 0.0)):
        for place in (field, f"walls/0/{field}"):
            before, after = (payload(**{place: np.array([v], dtype=dtype)}) for v in (0, 200))
            (distance,) = compared(before, after).distances
            assert distance.limit == allowed
