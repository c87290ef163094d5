"""Rasters as pictures for paper: native where print shows it, averaged where not, and contours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.files.drawings import printed_pictures
from orthoflow.files.drawings.printed_pictures import Stretch, contours, encode_part, stretch_of
from orthoflow.files.drawings.sheet_contents import Part
from orthoflow.files.geotiff import GridPlace, write_orthoimage, write_raster
from orthoflow.files.images import decode_image

WHOLE = Part(left_m=0.0, top_m=0.0, right_m=1.0, bottom_m=0.5)


def ramp(rows: int, columns: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    down, right = np.indices((rows, columns))
    return np.stack([right * 255 // columns, down * 255 // rows, 0 * right], axis=2).astype("u1")


def pictured(folder: Path, part: Part, scale: int) -> NDArray[np.uint8]:
    return decode_image(encode_part(folder / "a.tif", part, scale=scale))


def test_cells_of_a_part_are_kept_as_they_are_where_print_shows_them(tmp_path: Path) -> None:
    rgb = ramp(50, 100)
    shown = np.ones((50, 100), dtype=np.bool_)
    shown[:15] = False
    write_orthoimage(tmp_path / "a.tif", rgb, shown, place=GridPlace(gsd_m=0.01), tags={})
    part = Part(left_m=0.2, top_m=0.1, right_m=0.5, bottom_m=0.3)
    picture = pictured(tmp_path, part, 20)
    assert picture.shape == (20, 30, 3)
    np.testing.assert_array_equal(picture[5:], rgb[15:30, 20:50])
    assert (picture[:5] == 255).all()
    # The rows of a ceiling go up the paper; its parts are measured from the paper's upper edge.
    flipped = encode_part(tmp_path / "a.tif", part, scale=20, is_flipped=True)
    np.testing.assert_array_equal(decode_image(flipped), rgb[39:19:-1, 20:50])


def test_finer_cells_than_print_shows_are_averaged_to_400_per_inch(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (1000, 2000, 3), dtype=np.uint8)
    shown = np.ones((1000, 2000), np.bool_)
    write_orthoimage(tmp_path / "a.tif", rgb, shown, place=GridPlace(gsd_m=0.0005), tags={})
    # 1 m at 1:50 is 20 mm: 0.787 inches, 315 pixels of 6.35 cells.
    picture = pictured(tmp_path, WHOLE, 50)
    assert picture.shape == (158, 315, 3)
    # The mean of 40 independent cells is 40 times less wild, and as bright.
    assert picture.mean() == pytest.approx(rgb.mean(), abs=1.0)
    assert picture.std() < rgb.std() / 3


def test_large_pictures_are_jpeg_with_the_colours_they_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rgb = np.empty((300, 400, 3), dtype=np.uint8)
    rgb[:, :200], rgb[:, 200:] = (200, 40, 90), (10, 220, 30)
    write_orthoimage(
        tmp_path / "a.tif", rgb, np.ones((300, 400), np.bool_), place=GridPlace(gsd_m=0.1), tags={}
    )
    part = Part(left_m=0.0, top_m=0.0, right_m=40.0, bottom_m=30.0)
    for lossless_px, magic in ((120_000, b"\x89PNG"), (119_999, b"\xff\xd8")):
        monkeypatch.setattr(printed_pictures, "LOSSLESS_PX", lossless_px)
        encoded = encode_part(tmp_path / "a.tif", part, scale=50)
        assert encoded.startswith(magic)
    picture = decode_image(encoded).astype(int)
    assert picture.shape == (300, 400, 3)
    # No chroma is thinned out: beside the edge too colours are right to JPEG's rounding.
    assert np.abs(picture[:, :190] - (200, 40, 90)).max() <= 3
    assert np.abs(picture[:, 210:] - (10, 220, 30)).max() <= 3


def test_grey_is_stretched_and_nothing_is_white(tmp_path: Path) -> None:
    values = np.tile(np.linspace(0.0, 1.0, 101, dtype=np.float32)[:100], (50, 1))
    values[:, :10] = np.nan
    write_raster(tmp_path / "a.tif", values, place=GridPlace(gsd_m=0.01), tags={})
    stretch = stretch_of(tmp_path / "a.tif")
    low, high = np.nanpercentile(values, (2, 98))
    assert (stretch.low, stretch.high) == (pytest.approx(low), pytest.approx(high))
    picture = pictured(tmp_path, WHOLE, 20)
    assert (picture[:, :10] == 255).all()
    assert (picture[:, 11] == 0).all()
    assert (np.diff(picture[0, 10:, 0].astype(int)) >= 0).all()
    # Nobody saw anything.
    write_raster(tmp_path / "a.tif", values * np.nan, place=GridPlace(gsd_m=0.01), tags={})
    stretch = stretch_of(tmp_path / "a.tif")
    assert (stretch.low, stretch.high) == (0.0, 1.0)
    assert (pictured(tmp_path, WHOLE, 20) == 255).all()
    assert contours(tmp_path / "a.tif", WHOLE, scale=10, interval_m=0.1) == []


@pytest.mark.parametrize(("noise_m", "atol_m"), [(0.0, 1e-6), (0.002, 0.012)])
def test_contours_of_a_slope_are_where_it_has_their_depth(
    tmp_path: Path, noise_m: float, atol_m: float
) -> None:
    # Depth grows by 0.2 m over a metre to the right.
    slope = np.tile(0.2 * (np.arange(200) + 0.5) / 200.0, (100, 1))
    noisy = np.random.default_rng(4).normal(slope, noise_m).astype(np.float32)
    write_raster(tmp_path / "a.tif", noisy, place=GridPlace(gsd_m=0.005), tags={})
    found = contours(tmp_path / "a.tif", WHOLE, scale=10, interval_m=0.05)
    assert [level for level, _ in found] == pytest.approx([0.025, 0.075, 0.125, 0.175])
    for level, points in found:
        # float32 depths of 0.2 m are known to 1e-8 m; without averaging noise of 2 mm moves them
        # by 10 mm.
        np.testing.assert_allclose(points[:, 0], level / 0.2, atol=atol_m)
        assert np.std(points[:, 0] - level / 0.2) < 0.003
        assert noise_m or np.ptp(points[:, 1]) == pytest.approx(0.495, abs=1e-9)


@pytest.mark.parametrize("n_rows", [1, 2, 3])
def test_two_rows_are_enough_for_a_contour_between_them(tmp_path: Path, n_rows: int) -> None:
    rows = np.array([0.0, 0.1, 0.1], dtype=np.float32)[:n_rows]
    write_raster(
        tmp_path / "a.tif",
        np.repeat(rows[:, None], 40, axis=1),
        place=GridPlace(gsd_m=0.05),
        tags={},
    )
    whole = Part(left_m=0.0, top_m=0.0, right_m=2.0, bottom_m=0.05 * n_rows)
    found = contours(tmp_path / "a.tif", whole, scale=10, interval_m=0.1)
    assert [level for level, _ in found] == ([] if n_rows < 2 else [0.05])
    for _, points in found:
        np.testing.assert_allclose(points[:, 1], 0.05, atol=1e-9)


@pytest.mark.parametrize("depth_m", [0.0, 0.025])
def test_noise_of_a_flat_wall_draws_no_contours(tmp_path: Path, depth_m: float) -> None:
    """On the plane, and exactly on a level of the contours."""
    noise = np.random.default_rng(2).normal(depth_m, 0.002, (100, 200)).astype(np.float32)
    write_raster(tmp_path / "a.tif", noise, place=GridPlace(gsd_m=0.005), tags={})
    assert contours(tmp_path / "a.tif", WHOLE, scale=10, interval_m=0.05) == []
    stretch = stretch_of(tmp_path / "a.tif")
    assert stretch.noise == pytest.approx(0.002, rel=0.05)
    assert Stretch(low=0.0, high=0.0, noise=0.002).interval == pytest.approx(0.01)
    assert contours(tmp_path / "a.tif", WHOLE, scale=10, interval_m=stretch.interval) == []
