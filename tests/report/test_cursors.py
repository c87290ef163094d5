"""Where the cursor is in the world, and how deep the wall is there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.geometry import WallFrame
from orthoflow.report.cursors import CoarseDepths, coarse_depths, cursor_places
from tests import samples


def test_few_depths_are_all_told_in_millimetres() -> None:
    depth_m = np.array([[0.0014, -0.0016, np.nan], [1.2344, 0.0, np.inf]], dtype=np.float32)
    assert coarse_depths(depth_m) == CoarseDepths(
        columns=3, rows=2, depth_mm=(1, -2, None, 1234, 0, None)
    )


@pytest.mark.parametrize("shape", [(400, 800), (801, 399), (1, 7000), (7000, 1)])
def test_many_depths_are_told_at_about_eight_thousand_places(shape: tuple[int, int]) -> None:
    columns = np.arange(shape[1], dtype=np.float32)
    # A depth tells its column, in millimetres.
    found = coarse_depths(np.broadcast_to(columns / np.float32(1000.0), shape).astype(np.float32))
    assert len(found.depth_mm) == found.columns * found.rows <= 8_400
    if min(shape) > 1:
        assert found.columns * found.rows >= 7_800
        # As wide as high.
        assert found.columns / found.rows == pytest.approx(shape[1] / shape[0], rel=0.02)
    # In the middle of each coarse cell.
    middles = (np.arange(found.columns) + 0.5) * shape[1] / found.columns
    assert found.depth_mm[: found.columns] == tuple(middles.astype(int).tolist())


def frame(width: int = 4, gsd_m: float = 0.5) -> WallFrame:
    return samples.facing_east(gsd_m, width, 2, (1.0, 2.0, 3.0))


def picture(name: str, of: WallFrame | None, depths: CoarseDepths | None = None) -> Any:
    return SimpleNamespace(id=name, number=7, name="floor 7", frame=of, depths=depths)


def test_an_orthoimage_has_the_depths_of_the_wall_with_its_cells() -> None:
    depths = CoarseDepths(columns=2, rows=1, depth_mm=(5, None))
    other = CoarseDepths(columns=1, rows=1, depth_mm=(9,))
    walls = [
        picture("unplaced", None, other),
        picture("intensity", frame()),
        picture("wider", frame(5), other),
        picture("depth", frame(), depths),
        picture("later", frame(), other),
    ]
    [place] = cursor_places([picture("ortho", frame()), picture("unplaced", None)], walls)
    assert place == {
        "id": "ortho",
        "wall": 7,
        "name": "floor 7",
        "origin": [1.0, 2.0, 3.0],
        "u": [0.0, 1.0, 0.0],
        "v": [0.0, 0.0, -1.0],
        "n": [1.0, 0.0, 0.0],
        "gsd": 0.5,
        "width": 4,
        "height": 2,
        "columns": 2,
        "rows": 1,
        "mm": [5, None],
    }


def test_an_orthoimage_of_which_no_wall_has_the_cells_has_no_depths() -> None:
    [place] = cursor_places([picture("ortho", frame())], [picture("fine", frame(gsd_m=0.25))])
    assert (place["columns"], place["rows"], place["mm"]) == (0, 0, [])
