"""Blocks of arrays: joined they are the array, and none is larger than it may be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from orthoflow_provenance import blocks

SHAPES = [(1,), (7,), (8,), (9,), (3, 4), (2, 9), (5, 1, 2), (2, 3, 17), (1, 1, 40)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("most_bytes", [8, 64, 1 << 20])
def test_blocks_join_to_the_array_in_its_order(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...], most_bytes: int
) -> None:
    monkeypatch.setattr(blocks, "BLOCK_BYTES", most_bytes)
    array = np.arange(math.prod(shape), dtype=np.float64).reshape(shape)
    parts = [np.asarray(array[index]) for index in blocks.block_indices(shape, 8)]
    np.testing.assert_array_equal(np.concatenate([part.ravel() for part in parts]), array.ravel())
    assert max(part.nbytes for part in parts) <= most_bytes
    # As few as there can be.
    if len(shape) == 1:
        assert len(parts) == math.ceil(8 * shape[0] / most_bytes)


def test_a_number_larger_than_a_block_is_one_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 4)
    assert list(blocks.block_indices((2,), 4)) == [(slice(0, 1),), (slice(1, 2),)]


def test_nothing_has_no_block_and_a_scalar_has_one() -> None:
    assert list(blocks.block_indices((), 8)) == [()]
    for shape in ((0,), (3, 0), (0, 3)):
        assert list(blocks.block_indices(shape, 8)) == []
        assert list(blocks.byte_blocks(np.zeros(shape))) == []
    (scalar,) = blocks.byte_blocks(np.array(258, dtype=">u2"))
    assert scalar.tolist() == [2, 1]


def test_what_lies_in_order_is_given_whole_and_not_copied(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 16)
    array = np.arange(24, dtype="<u4").reshape(4, 6)
    (whole,) = blocks.byte_blocks(array)
    assert np.shares_memory(whole, array)
    for other in (array.astype(">u4"), np.asfortranarray(array), np.repeat(array, 2, 0)[::2]):
        parts = list(blocks.byte_blocks(other))
        assert len(parts) > 1
        assert max(part.nbytes for part in parts) <= 16
        assert b"".join(part.tobytes() for part in parts) == array.tobytes()


def test_bytes_lie_from_the_smallest_on() -> None:
    for code in ("<f4", ">f4", "=f4"):
        assert blocks.little_endian(np.dtype(code)) == np.dtype("<f4")
    assert blocks.little_endian(np.dtype("u1")).str == "|u1"
