"""Pictures of what was read: the pixels of views from above and of the scanner, and the sheet."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read import figures
from orthoflow_plugins.read.figures import (
    plan_view,
    polar_view_png,
    scan_lines_png,
)

from orthoflow.products import PointCloud
from tests.plane_scenes import cloud_of


def pixels(encoded: bytes | None) -> NDArray[np.uint8]:
    assert encoded is not None
    return np.asarray(cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_UNCHANGED))


# --- from above ---


def test_a_plan_is_as_bright_as_the_logarithm_of_its_points() -> None:
    # A grid of two by one metres with one point per pixel, and a corner with seven more.
    x, y = np.meshgrid(np.arange(640) / 320.0, np.arange(320) / 320.0)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    crowd = np.tile([1.6, 0.8, 3.0], (7, 1))
    shown, frame = plan_view(cloud_of(np.concatenate([grid, crowd])))
    # The outermost thousandth is cut off.
    assert shown.shape[1] == 640
    assert shown.shape[0] == pytest.approx(320, abs=2)
    values, counts = np.unique(shown, return_counts=True)
    # One point, two where points share a pixel, none between; eight or nine at the crowd.
    assert shown.max() == 255
    row, column = np.unravel_index(shown.argmax(), shown.shape)
    assert column / 639 == pytest.approx(0.8, abs=0.01)
    # Row 0 is the top: four fifths up.
    assert 1.0 - row / (len(shown) - 1) == pytest.approx(0.8, abs=0.01)
    # The middle of that pixel lies at the crowd, in metres of the world.
    place = frame.raster_from_wall(np.array([[column + 0.5, row + 0.5]]))[0]
    np.testing.assert_allclose(place, [1.6, 0.8], atol=0.004)
    assert frame.raster_axes == "level"
    single = values[counts.argmax()]
    crowded = {round(255.0 * np.log(2.0) / np.log(1.0 + n)) for n in (8, 9, 10)}
    assert int(single) in crowded


# --- as its scanner saw it ---


def scanned(rows: int = 20, columns: int = 30) -> PointCloud:
    """A station in the middle of a cylinder: row 0 lowest, column 0 in the east, to the left."""
    row, column = (grid.ravel() for grid in np.mgrid[:rows, :columns])
    azimuth, elevation = np.radians(3.0 * column), np.radians(2.0 * (row - 9.5))
    points = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    cloud = cloud_of(points, stations=np.zeros((1, 3)))
    return replace(
        cloud,
        row=row.astype(np.uint32),
        column=column.astype(np.uint32),
        intensity=(row / (rows - 1.0)).astype(np.float32),
    )


def expected_grey(cloud: PointCloud, rows: int, columns: int) -> NDArray[np.uint8]:
    """Brightness over rows and columns as they are numbered."""
    assert cloud.intensity is not None
    values = np.full((rows, columns), np.nan)
    values[cloud.row, cloud.column] = cloud.intensity
    low, high = np.nanquantile(values, (0.01, 0.99))
    bright = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.where(np.isnan(values), 0.0, np.rint(32.0 + 223.0 * bright)).astype(np.uint8)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("upside_down", [False, True])
def test_a_scan_is_shown_as_its_station_saw_it(mirrored: bool, upside_down: bool) -> None:
    cloud = scanned()
    # A place from which no point came, and a point more beside it.
    column = np.where((cloud.row == 3) & (cloud.column == 4), 5, cloud.column)
    cloud = replace(cloud, column=column.astype(np.uint32))
    # Azimuth grows with the columns: to the left.
    truth = expected_grey(cloud, 20, 30)[::-1, ::-1]
    if mirrored:
        cloud = replace(cloud, column=29 - cloud.column)
    if upside_down:
        cloud = replace(cloud, row=19 - cloud.row)
    here = np.array([400.0, -300.0, 50.0])
    cloud = replace(cloud, origin=here, stations=here[None])
    shown = pixels(polar_view_png(cloud))
    assert np.abs(shown.astype(int) - truth).max() <= 1
    assert shown[16, 25] == 0


# --- rows and columns in rectangular coordinates ---


def wall_scan(*, station_y: float = -2.0) -> PointCloud:
    """A wall of 4 x 2 m in y = 0 and one of 1 x 2 m beside it, scanned in 80 rows, 200 columns."""
    row, column = (grid.ravel() for grid in np.mgrid[:80, :200])
    x, z = 0.025 * column, 0.025 * row
    on_main = column < 160
    points = np.column_stack([np.minimum(x, 4.0), np.where(on_main, 0.0, -(x - 4.0)), z])
    cloud = cloud_of(points, stations=np.array([[2.0, station_y, 1.0]]))
    # The left half is dark.
    intensity = np.where(x < 2.0, 0.0, 1.0).astype(np.float32)
    rows, columns = row.astype(np.uint32), column.astype(np.uint32)
    return replace(cloud, row=rows, column=columns, intensity=intensity)


def test_rows_and_columns_are_lines_over_the_fullest_wall() -> None:
    shown = pixels(scan_lines_png(wall_scan()))[..., ::-1]
    # 3.975 m are 1200 pixels, and what is within 15 cm of the wall is drawn.
    assert shown.shape[1] == 1200
    assert shown.shape[0] == pytest.approx(1200 * 1.975 / 3.975, abs=8)
    is_row = (shown == figures._ROW_RGB).all(axis=2)
    is_column = (shown == figures._COLUMN_RGB).all(axis=2)
    # Every third of 80 rows, every seventh of 167 columns, straight from edge to edge; the last
    # of these lie on the other wall, one behind the other and beyond the picture.
    full_rows = (is_row | is_column).mean(axis=1) > 0.98
    full_columns = is_column.mean(axis=0) > 0.98
    assert 26 <= full_rows.sum() <= 27
    assert full_columns.sum() == 23
    assert set(np.diff(np.flatnonzero(full_rows))) <= {22, 23}
