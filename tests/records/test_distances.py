"""How far two products lie apart: by unit, within what their type allows, and what is unsaid."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from orthoflow_provenance.arrays import ArrayDifference

from orthoflow.errors import PluginError
from orthoflow.products.product import Payload, Tolerance
from orthoflow.records import comparison as module
from orthoflow.records.comparison import RunProducts, product_distances


def payload(version: int = 1, metadata: dict[str, Any] | None = None, **arrays: Any) -> Payload:
    return Payload(
        type_name="toy",
        encoding_version=version,
        metadata=metadata or {},
        arrays={name: np.asarray(value) for name, value in arrays.items()},
    )


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


class ToyRun:
    def __init__(self, **outputs: Any) -> None:
        self._payloads = {port: one for port, (one, _) in outputs.items()}
        self.cells = {
            "cell": SimpleNamespace(
                outputs={
                    port: SimpleNamespace(
                        type_name=type_name,
                        digest=f"{port}-{id(one)}" if one is not None else f"{port}-kept",
                        encoding_version=1 if one is None else one.encoding_version,
                        embedded=one is not None,
                    )
                    for port, (one, type_name) in outputs.items()
                }
            )
        }

    def payload(self, _address: str, port: str) -> Any:
        return self._payloads[port]


def compared(left: Any, right: Any, *, types: tuple[str, str] = ("toy", "toy")) -> Any:
    sides = [
        RunProducts(run=ToyRun() if one is ... else ToyRun(out=(one, kind)))  # type: ignore[arg-type]
        for one, kind in zip((left, right), types, strict=True)
    ]
    (found,) = product_distances(*sides, ["cell"], Catalog())  # type: ignore[arg-type]
    return found


def test_the_same_digest_is_the_same_product() -> None:
    one = payload(depth_m=[1.0])
    found = compared(one, one)
    assert (found.verdict, found.reason, found.distances) == ("identical", "", ())
    assert (found.cell, found.port, found.type_name) == ("cell", "out", "toy")
    assert found.left == found.right != ""


def test_what_only_one_run_has_is_different() -> None:
    for pair in ((payload(), ...), (..., payload())):
        found = compared(*pair)
        assert (found.verdict, found.reason) == ("different", "only one of the runs has it")
        assert (found.left == "") is (pair[0] is ...)


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


def test_the_fields_that_lie_apart_are_counted() -> None:
    before = payload(depth_m=[1.0], n=[1], rgb=np.array([[1]], dtype=np.uint8))
    after = payload(depth_m=[2.0], n=[3], rgb=np.array([[9]], dtype=np.uint8))
    found = compared(before, after)
    assert found.verdict == "different"
    assert found.reason.endswith("; 2 more fields differ")
    assert {one.unit: one.largest for one in found.distances} == {"m": 1.0, "1": 2.0, "grey": 8.0}


def test_equal_values_of_other_digests_are_identical() -> None:
    assert compared(payload(n=[1]), payload(n=[1])).verdict == "identical"


def test_what_cannot_be_had_is_not_measured() -> None:
    found = compared(payload(n=[1]), None)
    assert found.verdict == "not measured"
    assert "no record and no store at hand" in found.reason
    found = compared(payload(n=[1]), payload(n=[1]), types=("strange", "strange"))
    assert found.verdict == "not measured"
    assert found.reason == "the digests differ, and no product type strange"


@pytest.mark.parametrize(
    ("dtype", "limit"), [(np.uint8, 2.0), (np.uint16, 2.0 * 257), (np.int32, 2.0)]
)
def test_grey_of_sixteen_bits_counts_in_steps_of_257(dtype: Any, limit: float) -> None:
    grey, metres = Tolerance(limit=2.0, unit="grey"), Tolerance(limit=2.0, unit="m")
    one = payload(**{"walls/0/rgb": np.zeros(3, dtype=dtype)})
    assert module._limit("rgb", grey, one) == limit
    assert module._limit("rgb", metres, one) == 2.0
    assert module._limit("gb", grey, one) == 2.0
    assert module._limit("rgb", grey, payload(rgb=np.zeros(3, dtype=dtype))) == limit


def test_a_value_in_a_list_is_told_by_its_name_and_unit() -> None:
    def told(**beside: Any) -> Any:
        metadata = {"findings": [{"value": 0.5}, {**beside, "value": 2.0}]}
        name, at = "findings/1/value", payload(metadata=metadata)
        found = module._named(difference(name, "1", 0.5, 1), at)
        return found.name, found.unit

    assert told(name="rms_mm", unit="mm") == ("rms_mm, findings/1/value", "mm")
    assert told(unit="mm") == ("findings/1/value", "1")


def difference(name: str, unit: str, largest: float, n_values: int) -> ArrayDifference:
    one = compared_differences()[0]
    return replace(one, name=name, unit=unit, largest=largest, n_values=n_values, limit=0.5)


def compared_differences() -> list[ArrayDifference]:
    from orthoflow_provenance.arrays import measure_payloads

    return list(measure_payloads(payload(n=[1]), payload(n=[2]), {"n": (0.0, "1")}))


def test_of_each_unit_the_farthest_field_is_told_and_all_values_counted() -> None:
    found = module._by_unit(
        [
            difference("a", "m", 0.2, 3),
            difference("b", "px", 9.0, 1),
            difference("c", "m", 0.7, 4),
            difference("d", "deg", math.inf, 2),
        ]
    )
    assert [(one.unit, one.largest, one.field, one.n_values) for one in found] == [
        ("m", 0.7, "c", 7),
        ("px", 9.0, "b", 1),
        ("deg", None, "d", 2),
    ]
