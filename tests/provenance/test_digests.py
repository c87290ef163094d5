"""Digests see logical content, all of it, and nothing else."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from orthoflow_provenance.arrays import payload_digest
from orthoflow_provenance.document import RecordFormatError, canonical_json

from tests.provenance_records import Given

JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)

STRIPED = np.arange(24, dtype=np.float32).reshape(4, 6)


@given(JSON_VALUES)
def test_canonical_json_reads_back_to_the_same_value(value: object) -> None:
    read = json.loads(canonical_json(value))
    assert json.dumps(read, sort_keys=True) == json.dumps(value, sort_keys=True)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (float("nan"), "numbers in JSON must be finite, got nan at root"),
        ({"a": [0, float("inf")]}, "got inf at /a/1"),
        ({1: 2}, "keys of a JSON object must be text, got 1 at root"),
        ({"a": np.zeros(2)}, "JSON does not support ndarray, found at /a"),
        ("\ud800", "an unpaired surrogate"),
    ],
)
def test_what_is_not_json_is_refused(value: object, message: str) -> None:
    with pytest.raises(RecordFormatError, match=message):
        canonical_json(value)


def test_the_digest_is_the_one_that_the_specification_describes() -> None:
    depth = np.arange(6, dtype=">f4").reshape(2, 3)
    payload = Given(metadata={"gsd_m": 0.01, "name": "Wänd"}, arrays={"walls/0/depth_m": depth})
    array_digest = hashlib.sha256(depth.astype("<f4").tobytes()).hexdigest()
    content = (
        '{"arrays":{"walls/0/depth_m":["<f4",[2,3],"' + array_digest + '"]},'
        '"encoding_version":1,"metadata":{"gsd_m":0.01,"name":"Wänd"},"type":"walls","v":1,'
        '"what":"orthoflow/product"}'
    )
    assert payload_digest(payload) == "sha256:" + hashlib.sha256(content.encode()).hexdigest()
    assert payload_digest(payload) == (
        "sha256:6eab819bb17fb277001d7da91ed23fa9f4a617752842f39c858bfbdfcaf50f90"
    )


@pytest.mark.parametrize(
    "same",
    [
        pytest.param(lambda array: array.astype(">f4"), id="big-endian"),
        pytest.param(np.asfortranarray, id="Fortran order"),
        pytest.param(lambda array: np.repeat(array, 2, axis=1)[:, ::2], id="strided"),
        pytest.param(lambda array: array[::-1].copy()[::-1], id="negative strides"),
    ],
)
def test_memory_layout_does_not_show_in_the_digest(
    same: Callable[[NDArray[np.float32]], NDArray[np.float32]],
) -> None:
    assert payload_digest(Given(arrays={"a": same(STRIPED)})) == payload_digest(
        Given(arrays={"a": STRIPED})
    )


def test_everything_logical_shows_in_the_digest() -> None:
    zeros = np.zeros((2, 3), dtype=np.float32)
    different = [
        Given(arrays={"a": zeros}),
        Given(arrays={"a": zeros}, type_name="layers"),
        Given(arrays={"a": zeros}, encoding_version=2),
        Given(arrays={"a": zeros}, metadata={"a": 1}),
        Given(arrays={"a": zeros}, metadata={"a": 1.0}),
        Given(arrays={"b": zeros}),
        Given(arrays={"a": zeros.reshape(3, 2)}),
        Given(arrays={"a": zeros.reshape(-1)}),
        Given(arrays={"a": zeros.astype(np.int32)}),
        Given(arrays={"a": -zeros}),
        Given(arrays={"a": zeros, "b": zeros}),
        Given(arrays={"a": np.zeros((0, 3), dtype=np.float32)}),
        Given(arrays={"a": np.zeros((0, 4), dtype=np.float32)}),
        Given(),
    ]
    assert len({payload_digest(payload) for payload in different}) == len(different)
