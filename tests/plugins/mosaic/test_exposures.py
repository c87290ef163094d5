"""What is added to light: fields between their nodes, lenses, and the equations of overlaps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import balance as module
from orthoflow_plugins.mosaic.balance import Exposures, Radii, estimate
from orthoflow_plugins.mosaic.blocks import BlockLight


def light(rows: slice, columns: slice, seed: int, unknown: float = 0.0) -> BlockLight:
    rng = np.random.default_rng(seed)
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    logs = rng.normal(-1.0, 0.5, (*shape, 3)).astype(np.float32)
    logs[rng.random(shape) < unknown] = np.nan
    return BlockLight(box=(rows, columns), log_light=logs)


def radii(of: BlockLight, seed: int, lens: int) -> Radii:
    values = np.random.default_rng(seed).uniform(0.0, 1.0, of.log_light.shape[:2])
    return Radii(values=values.astype(np.float32), lens=lens)


LIGHTS = [
    light(slice(0, 9), slice(0, 12), 1, 0.2),
    light(slice(3, 14), slice(5, 20), 2, 0.2),
    light(slice(2, 7), slice(8, 30), 3),
    # Beside all others.
    light(slice(40, 44), slice(0, 4), 4),
]
RADII: list[Radii | None] = [radii(LIGHTS[0], 5, 1), None, radii(LIGHTS[2], 6, 0), None]


def some_exposures(seed: int) -> Exposures:
    rng = np.random.default_rng(seed)
    return Exposures(
        exposures=rng.normal(size=(4, 3)),
        lenses=rng.normal(size=(2, 2)),
        nodes=rng.normal(size=(4, 4, 4, 3)),
    )


@pytest.mark.parametrize("index", [0, 1])
def test_light_gets_an_exposure_a_field_and_the_loss_of_a_lens(index: int) -> None:
    found = some_exposures(7)
    logs = found.logs(index, LIGHTS[index], RADII[index])
    rows, columns = LIGHTS[index].log_light.shape[:2]
    places = np.linspace(0.0, 1.0, 4)
    for row, column in ((0, 0), (4, 7), (rows - 1, columns - 1)):
        down, across = (row + 0.5) / rows, (column + 0.5) / columns
        for channel in range(3):
            sides = [np.interp(across, places, side) for side in found.nodes[index, :, :, channel]]
            wanted = found.exposures[index, channel] + np.interp(down, places, sides)
            seen = RADII[index]
            if seen is not None:
                square = float(seen.values[row, column]) ** 2
                wanted += found.lenses[1] @ [square, square**2]
            assert logs[row, column, channel] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(("n_shared", "n_taken"), [(3, 0), (4, 4), (200, 200), (300, 200)])
def test_an_overlap_has_four_blocks_and_two_hundred_say_all(n_shared: int, n_taken: int) -> None:
    one = light(slice(0, 1), slice(0, n_shared), 1)
    other = light(slice(0, 1), slice(0, n_shared + 5), 2)
    overlaps = module._overlaps([one, other])
    assert sum(len(item.apart) for item in overlaps) == n_taken
    if n_taken:
        columns = overlaps[0].places[0][:, 1]
        # Evenly, from end to end.
        assert (columns[0], columns[-1]) == (0, n_shared - 1)
        assert set(np.diff(columns)) <= {n_shared // n_taken, -(-n_shared // n_taken)}


def two(apart: NDArray[np.float64], n_columns: int = 40) -> list[BlockLight]:
    """Two layers over the same blocks; the second is brighter by so much, in logarithms."""
    box = (slice(0, 10), slice(0, n_columns))
    logs = np.random.default_rng(3).normal(-1.0, 0.4, (10, n_columns, 3))
    pair = (logs, logs + apart)
    return [BlockLight(box=box, log_light=one.astype(np.float32)) for one in pair]


def test_what_is_between_two_exposures_is_shared_alike() -> None:
    found = estimate(two(np.array([0.4, 0.2, 0.3])), [None, None], is_local=False)
    apart = found.exposures[0] - found.exposures[1]
    np.testing.assert_allclose(apart, [0.4, 0.2, 0.3], atol=1e-3)
    np.testing.assert_allclose(found.exposures[0], -found.exposures[1], atol=1e-3)
    # Fields are held at nothing, and there is no lens.
    assert np.abs(found.nodes).max() < 1e-6
    assert found.lenses.shape == (0, 2)


def test_what_no_exposure_explains_goes_into_smooth_fields() -> None:
    # From left to right by a tenth, once as much on either side of the middle.
    slope = np.linspace(-0.05, 0.05, 40)[None, :, None]
    lights = two(np.broadcast_to(slope, (10, 40, 3)))
    found = estimate(lights, [None, None])
    added = found.logs(0, lights[0], None) - found.logs(1, lights[1], None)
    np.testing.assert_allclose(added, np.broadcast_to(slope, added.shape), atol=0.015)
    flat = estimate(lights, [None, None], is_local=False)
    left = flat.logs(0, lights[0], None) - flat.logs(1, lights[1], None)
    assert np.abs(left).max() < 0.01


def test_a_moved_thing_does_not_count() -> None:
    apart = np.full((10, 40, 3), 0.3)
    # A fifth of the blocks shows something else.
    apart[:, :8] = 1.5
    found = estimate(two(apart), [None, None], is_local=False)
    assert (found.exposures[0] - found.exposures[1]) == pytest.approx([0.3] * 3, abs=0.01)


def blocks(sizes: list[int]) -> Any:
    """Overlaps of so many blocks."""
    nothing = np.zeros((0, 2), dtype=np.int64)
    return [
        module._Overlap(layers=(0, k + 1), places=(nothing, nothing), apart=np.zeros((size, 3)))
        for k, size in enumerate(sizes)
    ]


def pull(
    matrix: NDArray[np.float64],
    found: NDArray[np.float64],
    apart: NDArray[np.float64],
    priors: NDArray[np.float64],
    sizes: list[int],
) -> NDArray[np.float64]:
    """How far each unknown would move by itself: nothing where robust least squares ended.

    A pair's residuals have a spread, of a hundredth at least; of more than fifty blocks the others
    say nothing new; what lies two spreads off counts half.
    """
    left = apart - matrix @ found
    weights = np.empty(len(apart))
    first = 0
    for size in sizes:
        part = slice(first, first + size)
        lengths = np.abs(left[part]).mean(axis=1)
        spread = max(0.01, 1.4826 * float(np.median(lengths)))
        weights[part] = min(1.0, 50.0 / size) / spread**2 / (1.0 + (lengths / (2.0 * spread)) ** 2)
        first += size
    gradient = matrix.T @ (weights[:, None] * left) - found / priors[:, None] ** 2
    curvature = (weights[:, None] * matrix**2).sum(axis=0) + 1.0 / priors**2
    return gradient / curvature[:, None]


@pytest.mark.parametrize("noise", [0.002, 0.03, 0.3])
@pytest.mark.parametrize("sizes", [[30, 12], [50, 51], [120, 9, 200]], ids=str)
def test_what_is_found_is_robust_least_squares(sizes: list[int], noise: float) -> None:
    from scipy.sparse import csr_array

    rng = np.random.default_rng(9)
    matrix = rng.normal(size=(sum(sizes), 4))
    priors = np.array([1.0, 0.5, 0.05, 2.0])
    true = 0.3 * priors[:, None] * rng.normal(size=(4, 3))
    apart = matrix @ true + noise * rng.normal(size=(sum(sizes), 3))
    apart[::9] += 1.0
    found = module._solved([csr_array(matrix)], apart, priors, blocks(sizes))
    # Of what the noise leaves unknown of them, a small part; it would be most of it otherwise.
    assert np.abs(pull(matrix, found, apart, priors, sizes)).max() < 0.02 * noise + 1e-4
