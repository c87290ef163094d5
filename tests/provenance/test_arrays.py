"""Products come back from their files as they went in, and a full disk is an ordinary error."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from orthoflow_provenance.arrays import (
    ArrayDifference,
    Tolerances,
    measure_payloads,
    payload_digest,
    read_product_file,
    write_product_file,
)
from orthoflow_provenance.document import JsonValue, PayloadLike, RecordFormatError, canonical_json

from tests.provenance_records import Given, cloud_payload, walls_payload

NUMBERS = (
    npst.boolean_dtypes() | npst.integer_dtypes() | npst.unsigned_integer_dtypes()
) | npst.floating_dtypes(sizes=(16, 32, 64))
ARRAYS = npst.arrays(NUMBERS, npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=40))
# One level each, so that no array lies below another one.
NAMES = st.text(st.characters(categories=["L", "N", "P"], exclude_characters="/"), min_size=1).map(
    lambda text: f"field/{text}0"
)


@settings(max_examples=25)
@given(
    arrays=st.dictionaries(NAMES, ARRAYS, max_size=4),
    metadata=st.dictionaries(
        st.text(st.characters(exclude_categories=["Cs"])), st.floats(allow_nan=False) | st.text()
    ).filter(lambda value: "inf" not in repr(value)),
    is_mapped=st.booleans(),
)
def test_a_product_comes_back_from_its_file(
    tmp_path_factory: pytest.TempPathFactory,
    arrays: dict[str, np.ndarray],
    metadata: dict[str, float | str],
    is_mapped: bool,
) -> None:
    path = tmp_path_factory.mktemp("product") / "product.h5"
    payload = Given(arrays=arrays, metadata=metadata, mapped=is_mapped)
    digest = write_product_file(path, payload)
    stored = read_product_file(path)
    assert stored.digest == digest == payload_digest(payload) == payload_digest(stored)
    assert (stored.type_name, stored.encoding_version) == ("walls", 1)
    assert (stored.metadata, stored.mapped) == (metadata, is_mapped)
    assert stored.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        assert stored.arrays[name].dtype == array.dtype.newbyteorder("<")
        assert stored.arrays[name].shape == array.shape
        np.testing.assert_array_equal(stored.arrays[name], array)


def test_rasters_are_packed_with_checksums_and_clouds_lie_plain_for_mapping(tmp_path: Path) -> None:
    write_product_file(tmp_path / "walls.h5", walls_payload())
    write_product_file(tmp_path / "cloud.h5", cloud_payload())
    with h5py.File(tmp_path / "walls.h5") as file:
        depth = file["product/arrays/walls/0/depth_m"]
        assert (depth.compression, depth.compression_opts) == ("gzip", 1)
        assert (depth.shuffle, depth.fletcher32) == (True, True)
        assert file["product/arrays/walls/0/origin_world"].chunks is None
    with h5py.File(tmp_path / "cloud.h5") as file:
        assert file["product/arrays/x"].chunks is None
        assert file["product/arrays/x"].id.get_offset() % 64 == 0
    array = read_product_file(tmp_path / "cloud.h5").arrays["x"]
    assert isinstance(array.base, np.memmap)
    assert (array.flags.aligned, array.flags.writeable) == (True, False)
    np.testing.assert_array_equal(array, cloud_payload().arrays["x"])


def test_arrays_of_any_memory_layout_larger_than_a_block_come_back(tmp_path: Path) -> None:
    values = np.arange(3 * 1_100_000, dtype=np.float64).reshape(-1, 3)
    arrays = {"columns": values.T, "every_other": values[::2]}
    digest = write_product_file(tmp_path / "a.h5", Given(arrays=arrays))
    stored = read_product_file(tmp_path / "a.h5")
    np.testing.assert_array_equal(stored.arrays["columns"], values.T)
    np.testing.assert_array_equal(stored.arrays["every_other"], values[::2])
    assert payload_digest(stored) == digest


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (Given(arrays={"a//b": np.zeros(1)}), "the array '' cannot be a name in a record"),
        (Given(arrays={"a/..": np.zeros(1)}), "the array '..' cannot be a name in a record"),
        (Given(arrays={"a\nb": np.zeros(1)}), "or contain `/` or control characters"),
        (Given(type_name=""), "the product type '' cannot be a name"),
        (
            Given(arrays={"a": np.zeros(1), "a/b": np.zeros(1)}),
            "the array a/b cannot be inside a, which is itself an array",
        ),
        (Given(arrays={"a": np.zeros(1, dtype="U4")}), "cannot be stored"),
        (Given(metadata={"a": float("nan")}), "numbers in JSON must be finite"),
    ],
)
def test_payloads_that_cannot_be_stored_leave_no_file(
    tmp_path: Path, payload: Given, message: str
) -> None:
    with pytest.raises(RecordFormatError, match=message):
        write_product_file(tmp_path / "a.h5", payload)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("part", ["dataset metadata", "group arrays"])
def test_a_product_without_one_of_its_parts_is_refused(tmp_path: Path, part: str) -> None:
    write_product_file(tmp_path / "a.h5", walls_payload())
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["product"][part.split()[1]]
    with pytest.raises(RecordFormatError, match=f"lacks the {part}"):
        read_product_file(tmp_path / "a.h5")


def test_a_file_is_not_written_through_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "a", tmp_path / "link"
    path.write_bytes(b"before")
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic links"):
        write_product_file(link, Given())
    assert path.read_bytes() == b"before"


FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from orthoflow_provenance.arrays import read_product_file, write_product_file
from tests.provenance_records import Given

path = Path(sys.argv[1], "a.h5")
noise = np.random.default_rng(0).integers(0, 255, 150_000, dtype=np.uint8)
for is_mapped in (True, False):
    both = Given(arrays={"a": noise, "b": noise}, mapped=is_mapped)
    for limit_bytes in (0, 1000, 75_000, 299_000, 301_000):
        # A limit on the size of files fails where a full disk does: in the middle of a write.
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, resource.RLIM_INFINITY))
        try:
            write_product_file(path, both)
        except OSError as error:
            print(error.errno, path.exists())
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    write_product_file(path, both)
    print(read_product_file(path).arrays["a"].sum() == noise.sum())
    path.unlink()
"""


def test_a_full_disk_is_an_ordinary_error_and_the_process_lives(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": f"{root}:{root / 'provenance'}", "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert (done.returncode, done.stderr) == (0, "")
    # EFBIG, the half-written file is gone.
    assert done.stdout == ("27 False\n" * 5 + "True\n") * 2


# Digests see logical content, all of it, and nothing else -----------------------------------------


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


def test_memory_layout_does_not_show_in_the_digest() -> None:
    same = (
        STRIPED.astype(">f4"),
        np.asfortranarray(STRIPED),
        np.repeat(STRIPED, 2, axis=1)[:, ::2],
        STRIPED[::-1].copy()[::-1],
    )
    assert len({payload_digest(Given(arrays={"a": array})) for array in (STRIPED, *same)}) == 1


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


# Two products compared number by number, within limits that carry a unit --------------------------


LIMITS = {"depth_m": (1e-4, "m"), "gsd_m": (1e-6, "m"), "rgb": (2.0, "grey")}


def beyond_limits(
    left: PayloadLike, right: PayloadLike, tolerances: Tolerances
) -> tuple[ArrayDifference, ...]:
    measured = measure_payloads(left, right, tolerances)
    return tuple(difference for difference in measured if difference.n_values)


def compare(
    left: NDArray[np.generic], right: NDArray[np.generic], name: str = "walls/0/depth_m"
) -> tuple[ArrayDifference, ...]:
    return beyond_limits(Given(arrays={name: left}), Given(arrays={name: right}), LIMITS)


def test_a_difference_within_the_limit_is_none_and_beyond_it_is_measured() -> None:
    depth = np.zeros((4, 5))
    moved = depth.copy()
    moved[1, 2], moved[3, 3] = 9e-5, -0.25
    assert compare(depth, np.where(moved < 0, 0, moved)) == ()
    (difference,) = compare(depth, moved)
    assert difference == ArrayDifference(
        name="walls/0/depth_m",
        largest=0.25,
        limit=1e-4,
        unit="m",
        n_values=1,
        problem="1 of 20 values differ by more than 0.0001 m, the largest by 0.25",
    )


def test_nan_equals_nan_and_nothing_else() -> None:
    left = np.array([np.nan, 1.0, np.nan])
    assert compare(left, left.copy()) == ()
    (difference,) = compare(left, np.array([np.nan, np.nan, 1.0]))
    assert (difference.largest, difference.n_values) == (math.inf, 2)


def test_unsigned_integers_do_not_wrap_around() -> None:
    left, right = np.array([0], dtype=np.uint8), np.array([2], dtype=np.uint8)
    assert compare(left, right, "rgb") == ()
    assert compare(right, left, "rgb") == ()


@pytest.mark.parametrize(
    ("right", "problem"),
    [
        (np.zeros((5, 4)), "float64 of shape (4, 5) versus float64 of shape (5, 4)"),
        (
            np.zeros((4, 5), dtype=np.float32),
            "float64 of shape (4, 5) versus float32 of shape (4, 5)",
        ),
    ],
)
def test_other_shapes_and_types_cannot_be_compared(
    right: NDArray[np.generic], problem: str
) -> None:
    (difference,) = compare(np.zeros((4, 5)), right)
    assert (difference.problem, difference.largest) == (problem, math.inf)


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        ({"walls": [{"gsd_m": 0.01}]}, {"walls": [{"gsd_m": 0.0100005}]}, []),
        (
            {"walls": [{"gsd_m": 0.01}]},
            {"walls": [{"gsd_m": 0.02}]},
            [("walls/0/gsd_m", "0.01 versus 0.02; the limit is 1e-06 m")],
        ),
        ({"a": 1}, {"a": 1.0}, []),
        ({"a": 1}, {"a": 2}, [("a", "1 versus 2; the limit is 0")]),
        ({"a": 1000.0}, {"a": 1000.0009}, []),
        ({"a": 1e-8}, {"a": 9e-7}, []),
        (
            {"a_px": 1000.0},
            {"a_px": 1000.002},
            [("a_px", "1000 versus 1000; the limit is 0.001 px")],
        ),
        ({"a": 1}, {"a": True}, [("a", "1 versus True")]),
        ({"a": "x"}, {"a": "y"}, [("a", "'x' versus 'y'")]),
        ({"a": [1]}, {"a": [1, 2]}, [("a", "[1] versus [1, 2]")]),
        ({"a": None}, {}, [("a", "it exists in only one of the products")]),
    ],
)
def test_metadata_are_compared_value_by_value(
    left: dict[str, JsonValue], right: dict[str, JsonValue], expected: list[tuple[str, str]]
) -> None:
    found = beyond_limits(Given(metadata=left), Given(metadata=right), LIMITS)
    assert [(difference.name, difference.problem) for difference in found] == expected
