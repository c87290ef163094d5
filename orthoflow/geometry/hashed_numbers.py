"""Random numbers as a function of a lattice cell, a seed and the index of the draw.

The same numbers result in any order and on any number of threads. The formulas are those of
`texture_kernels`, for whole arrays.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_WORD: Final = 1 << 64
_GOLDEN: Final = 0x9E3779B97F4A7C15
_COLUMN: Final = np.uint64(0xD1B54A32D192ED03)
_ROW: Final = np.uint64(0x8CB92BA72F3D8DD7)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_TURN: Final = 2.0 * np.pi


def cell_states(
    columns: NDArray[np.int64], rows: NDArray[np.int64], seed: int
) -> NDArray[np.uint64]:
    """Return random states (64 bits) of lattice cells; columns and rows are broadcast."""
    state = mixed_bits(columns.astype(np.uint64) * _COLUMN + np.uint64(seed % _WORD))
    return mixed_bits(state ^ (rows.astype(np.uint64) * _ROW))


def uniforms(states: NDArray[np.uint64], draw: int) -> NDArray[np.float64]:
    """Return numbers in [0, 1), one per state; another draw gives other numbers."""
    bits = mixed_bits(states + np.uint64((draw + 1) * _GOLDEN % _WORD))
    bits >>= np.uint64(11)
    return np.multiply(bits, 1.0 / 9007199254740992.0, dtype=np.float64)


def normals(states: NDArray[np.uint64], draw: int) -> NDArray[np.float64]:
    """Return normally distributed numbers (Box and Muller), one per state and even draw."""
    lengths = np.sqrt(-2.0 * np.log1p(-uniforms(states, draw)))
    return np.asarray(lengths * np.cos(_TURN * uniforms(states, draw + 1)), dtype=np.float64)


def mixed_bits(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scramble 64 bits (splitmix64's finaliser); neighbouring inputs give unrelated outputs."""
    bits = values ^ (values >> np.uint64(30))
    bits *= _FIRST
    bits ^= bits >> np.uint64(27)
    bits *= _SECOND
    bits ^= bits >> np.uint64(31)
    return bits
