"""Where the limits of the format lie: what is just allowed, and what is just not."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from orthoflow_provenance import layout, payloads
from orthoflow_provenance.blocks import BLOCK_BYTES, block_indices, byte_blocks
from orthoflow_provenance.compare import measure_payloads
from orthoflow_provenance.encoding import set_attributes, text_attribute
from orthoflow_provenance.errors import RecordFormatError
from orthoflow_provenance.model import RUN_FORMAT, RUN_FORMAT_VERSION, JsonValue
from orthoflow_provenance.safe import check_format, safe_open

from tests.provenance_records import Given

MIB = 1 << 20


def groups(file: h5py.File, over: int) -> None:
    file.create_group("/".join("g" * (32 + over)))


def attribute(file: h5py.File, over: int) -> None:
    file.attrs["a"] = np.zeros(MIB + over, np.uint8)


def chunk(file: h5py.File, over: int) -> None:
    file.create_dataset("a", (1,), np.uint8, maxshape=(None,), chunks=(64 * MIB + over,))


def unpacked(file: h5py.File, over: int) -> None:
    file.create_dataset("a", (64 * MIB + over,), np.uint8, chunks=(1000,))


@pytest.mark.parametrize("make", [groups, attribute, chunk, unpacked])
def test_a_file_is_refused_from_just_beyond_each_limit_on(
    tmp_path: Path, make: Callable[[h5py.File, int], None]
) -> None:
    path = tmp_path / "a.h5"
    for over in (0, 1):
        with h5py.File(path, "w", libver=("v110", "v110")) as file:
            make(file, over)
        if over:
            with pytest.raises(RecordFormatError), safe_open(path):
                pass
        else:
            with safe_open(path):
                pass


def test_rows_of_numbers_and_fixed_text_are_allowed(tmp_path: Path) -> None:
    kind = np.dtype([("a", "f8"), ("b", "i4"), ("c", "S7"), ("d", "?")])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"] = np.zeros(3, kind)
    with safe_open(tmp_path / "a.h5") as file:
        assert file["a"].dtype == kind


@pytest.mark.parametrize("place", ["note", "notesbook", "a/notes"])
def test_notes_have_one_place(tmp_path: Path, place: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[place] = "text of variable length"
        set_attributes(file, {"format": RUN_FORMAT, "format_version": RUN_FORMAT_VERSION})
    with pytest.raises(RecordFormatError, match="type outside"), safe_open(tmp_path / "a.h5"):
        pass


# --- numbers in decimal digits ---


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0", 0),
        ("-7", -7),
        ("9" * 99, 10**99 - 1),
        ("-" + "9" * 99, 1 - 10**99),
        ("9" * 100, None),
        ("--7", None),
        ("7.0", None),
        ("²", None),
        ("٣", None),
        ("", None),
    ],
)
def test_seeds_are_read_from_at_most_99_digits(
    tmp_path: Path, text: str, value: int | None
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for is_optional in (False, True):
            codec = layout._digits(is_optional=is_optional)
            set_attributes(file, {"seed": text})
            if value is not None:
                codec.write(file, "seed", value)
                assert text_attribute(file, "seed") == text
                assert codec.read(file, "seed") == value
            elif is_optional and not text:
                codec.write(file, "seed", None)
                assert codec.read(file, "seed") is None
            else:
                with pytest.raises(RecordFormatError, match="whole number in decimal digits, got"):
                    codec.read(file, "seed")


# --- versions ---


@pytest.mark.parametrize(
    ("version", "problem"),
    [
        ("1.0", ""),
        ("1.99", ""),
        ("2.0", "has format version '?2.0'?, this program reads version 1.2: use a newer"),
        ("0.9", "this program reads version 1.2"),
        *((odd, "like no other") for odd in ("1", "1.", ".1", "1.x", "x.1", "1.2.3", "٣.٤", "1,2")),
    ],
)
def test_a_later_minor_version_is_read_and_another_major_one_is_not(
    tmp_path: Path, version: str, problem: str
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        set_attributes(file, {"format": "orthoflow/toy", "format_version": version})
        if not problem:
            check_format(file, "orthoflow/toy", "1.2")
            return
        with pytest.raises(RecordFormatError, match=problem):
            check_format(file, "orthoflow/toy", "1.2")


# --- how arrays are cut ---


@pytest.mark.parametrize(
    ("shape", "itemsize", "blocks"),
    [
        ((0,), 8, []),
        ((3, 0), 8, []),
        ((), 8, [()]),
        ((3,), 8, [(slice(0, 3),)]),
        ((BLOCK_BYTES,), 1, [(slice(0, BLOCK_BYTES),)]),
        ((BLOCK_BYTES + 1,), 1, [(slice(0, BLOCK_BYTES),), (slice(BLOCK_BYTES, BLOCK_BYTES + 1),)]),
        ((3, BLOCK_BYTES // 2), 1, [(slice(0, 2),), (slice(2, 3),)]),
        ((2, BLOCK_BYTES // 8), 8, [(slice(0, 1),), (slice(1, 2),)]),
        (
            (2, 2, BLOCK_BYTES // 8),
            8,
            [(0, slice(0, 1)), (0, slice(1, 2)), (1, slice(0, 1)), (1, slice(1, 2))],
        ),
    ],
)
def test_blocks_are_as_large_as_they_may_be(
    shape: tuple[int, ...], itemsize: int, blocks: list[tuple[int | slice, ...]]
) -> None:
    assert list(block_indices(shape, itemsize)) == blocks


def test_bytes_of_an_array_are_little_endian_in_c_order() -> None:
    array = np.array([[1, 2], [3, 4]], ">u2")
    for given in (array, array.astype("<u2"), np.asfortranarray(array)):
        assert b"".join(part.tobytes() for part in byte_blocks(given)) == bytes(
            [1, 0, 2, 0, 3, 0, 4, 0]
        )
    assert list(byte_blocks(np.zeros((0, 3)))) == []
    plain = np.arange(6.0)
    (whole,) = byte_blocks(plain)
    assert np.shares_memory(whole, plain)


@pytest.mark.parametrize(
    ("shape", "itemsize", "chunk_shape"),
    [
        ((10,), 8, (10,)),
        ((MIB,), 8, (MIB // 8,)),
        ((1000, 1024), 4, (256, 1024)),
        ((4, 1000, 1024), 4, (1, 256, 1024)),
        ((4, MIB, 3), 1, (1, MIB // 3, 3)),
        ((2, 3 * MIB), 1, (1, MIB)),
    ],
)
def test_chunks_are_whole_rows_of_about_a_megabyte(
    shape: tuple[int, ...], itemsize: int, chunk_shape: tuple[int, ...]
) -> None:
    found = payloads._chunk_shape(shape, itemsize)
    assert found == chunk_shape
    assert math.prod(found) * itemsize <= MIB


# --- what two products may differ by ---


@pytest.mark.parametrize(
    ("name", "left", "right", "said"),
    [
        ("rms_mm", 1.0, 1.0 + 2e-6, "1 against 1, 1e-06 mm are allowed"),
        ("rms_mm", 4.0, 5.0, "4 against 5, 5e-06 mm are allowed"),
        ("far_m", -8.0, 1.0, "-8 against 1, 8e-06 m are allowed"),
        ("n_points", 4, 5, "4 against 5, 0 are allowed"),
        ("n_points", 4, 5.0, "4 against 5, 5e-06 are allowed"),
        ("gsd_m", 0.0, 0.25, "0 against 0.25, 0.125 m are allowed"),
        ("turned_deg", 1.0, 2.0, "1 against 2, 2e-06 deg are allowed"),
        ("at_px", 1.0, 2.0, "1 against 2, 2e-06 px are allowed"),
        ("name", "a" * 80, "b", f"'{'a' * 59} against 'b'"),
        ("is_good", True, 1, "True against 1"),
        ("values", [1.0], [1.0, 2.0], "[1.0] against [1.0, 2.0]"),
        ("values", None, 0, "None against 0"),
    ],
)
def test_numbers_of_the_metadata_are_held_to_a_millionth(
    name: str, left: JsonValue, right: JsonValue, said: str
) -> None:
    limits = {"gsd_m": (0.125, "m")}
    one, other = Given(metadata={name: left}), Given(metadata={name: right})
    (found,) = measure_payloads(one, other, limits)
    assert (found.name, found.n_values, found.problem) == (name, 1, said)
    assert measure_payloads(one, one, limits) == ()


def test_differences_within_the_limits_are_told_with_what_is_allowed() -> None:
    limits = {"gsd_m": (0.125, "m"), "rgb": (2.0, "grey")}
    one = Given(metadata={"gsd_m": 1.0, "rms_mm": 2.0}, arrays={"walls/0/rgb": np.zeros(3)})
    other = Given(
        metadata={"gsd_m": 1.125, "rms_mm": 2.0 + 2e-6},
        arrays={"walls/0/rgb": np.array([2, 0, 1.0])},
    )
    found = {item.name: item for item in measure_payloads(one, other, limits)}
    assert {name: item.n_values for name, item in found.items()} == {
        "walls/0/rgb": 0,
        "gsd_m": 0,
        "rms_mm": 0,
    }
    rgb = found["walls/0/rgb"]
    assert (rgb.largest, rgb.limit, rgb.unit) == (2.0, 2.0, "grey")
    assert rgb.problem == "differs by 2 grey at most, 2 are allowed"
