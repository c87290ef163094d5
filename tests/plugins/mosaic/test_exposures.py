"""What is added to light: fields between their nodes, lenses, and the equations of overlaps."""

from __future__ import annotations

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
