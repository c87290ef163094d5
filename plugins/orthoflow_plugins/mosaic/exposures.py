"""What makes photos alike: an exposure each, the light their lens loses, a smooth field each.

A photo's light is told in logarithms, so that factors add up. Where two photos show the same
blocks of a wall, what is added to one less what is added to the other must be how they differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from orthoflow_plugins.mosaic.blocks import Box
from orthoflow_plugins.mosaic.light import BlockLight, inside, pairs

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# An overlap of fewer blocks says nothing, and more than so many say no more.
_LEAST_BLOCKS: Final = 4
_BLOCKS_MOST: Final = 200
_INDEPENDENT: Final = 50.0
# What two photos differ by in a block besides: at least.
_SPREAD_LEAST: Final = 0.01
# How far exposures, lens terms and nodes of fields may be expected from 0, in logarithms.
_EXPOSURE_PRIOR: Final = 1.0
_LENS_PRIOR: Final = 0.5
_FIELD_PRIOR: Final = 0.05
# Holds fields at 0.
_NO_FIELD: Final = 1e-9
# Nodes along each side of a field.
_NODES: Final = 4
_SWEEPS: Final = 6
_OUTLIER: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class Radii:
    """How far from the middle of its photo each block of a layer's box lies.

    Attributes:
        values: (rows, cols) float32, 1 in the corners of the photo.
        lens: number of the lens; photos of one lens lose light alike.
    """

    values: NDArray[np.float32]
    lens: int


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """What is added to the logarithm of the light of each layer.

    Attributes:
        exposures: (k, 3) per layer and channel.
        lenses: (lenses, 2) of r^2 and r^4, r being 1 in the corners of a photo.
        nodes: (k, 4, 4, 3) of the smooth fields, bilinear over the box of each layer.
    """

    exposures: NDArray[np.float64]
    lenses: NDArray[np.float64]
    nodes: NDArray[np.float64]

    def logs(self, index: int, light: BlockLight, radii: Radii | None) -> NDArray[np.float64]:
        """Give what is added (rows, cols, 3) in the blocks of a layer's box."""
        rows, columns = (_hats(np.arange(size), size) for size in light.log_light.shape[:2])
        logs: NDArray[np.float64] = self.exposures[index] + np.einsum(
            "ri,cj,ijk->rck", rows, columns, self.nodes[index], optimize=True
        )
        if radii is not None:
            logs += (_powers(radii.values) @ self.lenses[radii.lens])[..., None]
        return logs


@dataclass(frozen=True, kw_only=True)
class _Overlap:
    """Blocks that two layers show.

    Attributes:
        layers: the two.
        places: (n, 2) row and column of each block in the box of the first, and of the second.
        apart: (n, 3) logarithm of the light of the second less that of the first.
    """

    layers: tuple[int, int]
    places: tuple[NDArray[np.int64], NDArray[np.int64]]
    apart: NDArray[np.float64]


def estimate(
    lights: Sequence[BlockLight], radii: Sequence[Radii | None], *, is_local: bool = True
) -> Exposures:
    """Find what makes overlaps most alike, robustly: moved things and glare count little.

    Exposures and lenses come first, from what all channels have in common; exposures of channels
    and fields take up what is left, the fields as little as they can.

    Args:
        lights: of the layers of a wall.
        radii: of the same layers; None where a layer's camera is not known.
        is_local: find fields, too.
    """
    count = len(lights)
    n_lenses = 1 + max((item.lens for item in radii if item is not None), default=-1)
    overlaps = _overlaps(lights)
    if not overlaps:
        return Exposures(
            exposures=np.zeros((count, 3)),
            lenses=np.zeros((n_lenses, 2)),
            nodes=np.zeros((count, _NODES, _NODES, 3)),
        )
    apart = np.concatenate([item.apart for item in overlaps])
    exposures = _exposure_columns(overlaps, count)
    bends = _lens_columns(overlaps, radii, n_lenses)
    alike = _solved(
        [exposures, bends],
        apart.mean(axis=1, keepdims=True),
        np.repeat([_EXPOSURE_PRIOR, _LENS_PRIOR], [count, 2 * n_lenses]),
        overlaps,
    )
    lenses = alike[count:]
    field_prior = _FIELD_PRIOR if is_local else _NO_FIELD
    found = _solved(
        [exposures, _field_columns(overlaps, lights)],
        apart - bends @ lenses,
        np.repeat([_EXPOSURE_PRIOR, field_prior], [count, count * _NODES**2]),
        overlaps,
    )
    return Exposures(
        exposures=found[:count],
        lenses=lenses.reshape(n_lenses, 2),
        nodes=found[count:].reshape(count, _NODES, _NODES, 3),
    )


def _overlaps(lights: Sequence[BlockLight]) -> list[_Overlap]:
    found = []
    for i, j, shared in pairs(lights):
        parts = [inside(shared, lights[k].box) for k in (i, j)]
        known = lights[i].is_known[parts[0]] & lights[j].is_known[parts[1]]
        places = np.argwhere(known)
        if len(places) < _LEAST_BLOCKS:
            continue
        n_taken = min(len(places), _BLOCKS_MOST)
        places = places[np.linspace(0, len(places) - 1, n_taken).round().astype(np.int64)]
        one, other = (places + _corner(part) for part in parts)
        apart = lights[j].log_light[tuple(other.T)] - lights[i].log_light[tuple(one.T)]
        found.append(_Overlap(layers=(i, j), places=(one, other), apart=apart.astype(np.float64)))
    return found


def _corner(part: Box) -> NDArray[np.int64]:
    return np.array([part[0].start, part[1].start], dtype=np.int64)


def _exposure_columns(overlaps: Sequence[_Overlap], count: int) -> csr_array:
    """One column per layer: what is added to the first less what is added to the second."""
    from scipy.sparse import csr_array

    layers = np.repeat(
        [item.layers for item in overlaps], [len(item.apart) for item in overlaps], 0
    )
    n_rows = len(layers)
    values = np.tile([1.0, -1.0], n_rows)
    at = (np.repeat(np.arange(n_rows), 2), layers.ravel())
    return csr_array((values, at), shape=(n_rows, count))


def _lens_columns(
    overlaps: Sequence[_Overlap], radii: Sequence[Radii | None], n_lenses: int
) -> csr_array:
    """Two columns per lens."""
    from scipy.sparse import csr_array

    columns = np.zeros((sum(len(item.apart) for item in overlaps), 2 * n_lenses))
    first = 0
    for item in overlaps:
        rows = slice(first, first + len(item.apart))
        for layer, places, sign in zip(item.layers, item.places, (1.0, -1.0), strict=True):
            seen = radii[layer]
            if seen is not None:
                terms = sign * _powers(seen.values[tuple(places.T)])
                columns[rows, 2 * seen.lens : 2 * seen.lens + 2] += terms
        first = rows.stop
    return csr_array(columns)


def _field_columns(overlaps: Sequence[_Overlap], lights: Sequence[BlockLight]) -> csr_array:
    """A column per node of each layer's field."""
    from scipy.sparse import csr_array

    n_nodes = _NODES**2
    values, rows, columns = [], [], []
    first = 0
    for item in overlaps:
        n_blocks = len(item.apart)
        for layer, places, sign in zip(item.layers, item.places, (1.0, -1.0), strict=True):
            shape = lights[layer].log_light.shape
            hats = [_hats(places[:, axis], shape[axis]) for axis in (0, 1)]
            values.append(sign * np.einsum("ni,nj->nij", *hats).ravel())
            rows.append(np.repeat(np.arange(first, first + n_blocks), n_nodes))
            columns.append(np.tile(np.arange(n_nodes) + n_nodes * layer, n_blocks))
        first += n_blocks
    at = (np.concatenate(rows), np.concatenate(columns))
    return csr_array((np.concatenate(values), at), shape=(first, n_nodes * len(lights)))


def _hats(places: NDArray[np.int64], size: int) -> NDArray[np.float64]:
    """Weights (n, nodes) of the nodes along a side of so many blocks, linear between them."""
    at = (places + 0.5) / size * (_NODES - 1)
    return np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(_NODES)))


def _powers(radii: NDArray[np.floating]) -> NDArray[np.float64]:
    squares = np.asarray(radii, dtype=np.float64) ** 2
    return np.stack([squares, squares**2], axis=-1)


def _solved(
    columns: Sequence[csr_array],
    apart: NDArray[np.float64],
    priors: NDArray[np.float64],
    overlaps: Sequence[_Overlap],
) -> NDArray[np.float64]:
    """Robust least squares (unknowns, channels) with priors of 0.

    Weights are those of Cauchy, with the spread of each pair's residuals.
    """
    from scipy.sparse import diags_array, hstack
    from scipy.sparse.linalg import spsolve

    matrix = hstack(list(columns)).tocsr()
    ridge = diags_array(1.0 / priors**2)
    ends = np.cumsum([len(item.apart) for item in overlaps])
    weights = np.ones(len(apart))
    found = np.zeros((len(priors), apart.shape[1]))
    for sweep in range(_SWEEPS):
        residuals = np.abs(apart - matrix @ found).mean(axis=1)
        for part in np.split(np.arange(len(apart)), ends[:-1]):
            spread = max(_SPREAD_LEAST, 1.4826 * float(np.median(residuals[part])))
            counted = min(1.0, _INDEPENDENT / len(part)) / spread**2
            # At first nothing is known of exposures, and what lies apart is no outlier.
            limit = np.inf if sweep == 0 else _OUTLIER * spread
            weights[part] = counted / (1.0 + (residuals[part] / limit) ** 2)
        weighted = matrix.T @ diags_array(weights)
        normal = (weighted @ matrix + ridge).tocsc()
        found = np.reshape(spsolve(normal, weighted @ apart), found.shape)
    return found
