"""Products come back from their files as they went in, and a full disk is an ordinary error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from orthoflow_provenance.arrays import (
    payload_digest,
    read_product_file,
    write_product_file,
)
from orthoflow_provenance.document import RecordFormatError

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
noise = np.random.default_rng(0).integers(0, 255, 1_500_000, dtype=np.uint8)
for is_mapped in (True, False):
    both = Given(arrays={"a": noise, "b": noise}, mapped=is_mapped)
    for limit_bytes in (0, 1000, 750_000, 2_999_000, 3_001_000):
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
