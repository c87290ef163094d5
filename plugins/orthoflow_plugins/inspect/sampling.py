"""Which cells are compared with the truth: all of small walls, a fair part of large ones.

What is compared is exact; a part of it says as much about the whole as the whole does, as long as
it is spread evenly. Colours are rendered in whole blocks, since patches need neighbours; who sees a
cell is asked on a lattice, so that nothing wider than its step is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from orthoflow.products import Orthoimage, OrthoMask

# Whole patches of 32 cells, and so many that little is lost at the rim.
BLOCK_CELLS: Final = 96
# Multiples of these, modulo 1, fill a square most evenly (Roberts 2018, the R2 sequence).
_SPREAD: Final = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Which cells of an orthoimage are compared.

    Attributes:
        coloured: (rows, cols) bool, cells whose colour is.
        lattice: (rows, cols) bool, cells of which is asked who sees them.
    """

    coloured: NDArray[np.bool_]
    lattice: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SamplingRule:
    """How much of all walls is compared.

    Attributes:
        colour_share: share of blocks whose colours are compared.
        lattice_step: every so manyth row and column is asked who sees it.
    """

    colour_share: float
    lattice_step: int


def sampling_rule(
    images: Sequence[Orthoimage], *, colour_cells_most: int, seen_cells_most: int
) -> SamplingRule:
    """Find the share and the step that keep to about so many cells of all images together."""
    n_shown = sum(int(np.count_nonzero(shown(image))) for image in images)
    n_cells = sum(image.mask.size for image in images)
    return SamplingRule(
        colour_share=min(1.0, colour_cells_most / max(1, n_shown)),
        lattice_step=max(1, math.ceil(math.sqrt(n_cells / seen_cells_most))),
    )


def sampling(image: Orthoimage, rule: SamplingRule) -> Sampling:
    """Choose cells of an image; blocks that show nothing have no colours to compare."""
    shows = shown(image)
    coloured = np.zeros(shows.shape, dtype=np.bool_)
    for i in range(-(-shows.shape[0] // BLOCK_CELLS)):
        for j in range(-(-shows.shape[1] // BLOCK_CELLS)):
            block = (
                slice(i * BLOCK_CELLS, (i + 1) * BLOCK_CELLS),
                slice(j * BLOCK_CELLS, (j + 1) * BLOCK_CELLS),
            )
            is_chosen = (i * _SPREAD[0] + j * _SPREAD[1]) % 1.0 < rule.colour_share
            coloured[block] = is_chosen and shows[block].any()
    lattice = np.zeros(shows.shape, dtype=np.bool_)
    first = rule.lattice_step // 2
    lattice[first :: rule.lattice_step, first :: rule.lattice_step] = True
    return Sampling(coloured=coloured, lattice=lattice)


def shown(image: Orthoimage) -> NDArray[np.bool_]:
    """Cells that are painted or filled."""
    shows: NDArray[np.bool_] = np.isin(image.mask, (OrthoMask.PAINTED, OrthoMask.FILLED))
    return shows
