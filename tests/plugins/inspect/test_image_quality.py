"""Criteria for edges, shown cells and stretched cells, on both sides of each limit."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import image_quality
from orthoflow_plugins.inspect.image_quality import (
    cells_per_pixel,
    completeness,
    quality_findings,
    sharpness_findings,
)
from orthoflow_plugins.inspect.patches import GreyImage
from scipy.special import erf

from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.products import Orthoimage, OrthoMask, Wall
from tests import samples

SIDE, GSD_M = 20, 0.01
# Far from the origin, as in surveys.
FRAME = samples.facing_south(GSD_M, SIDE, SIDE, (5.0e6, 4.0e5, 100.0))
# The edge is in the middle of this column.
EDGE = 30


def edge(rows: int = 40, *, contrast: float = 100.0, columns: int = 61) -> NDArray[np.float64]:
    """Return a vertical edge between two grey levels, blurred by a Gaussian of one cell."""
    across = np.arange(columns) - EDGE
    row = 128.0 + 0.5 * contrast * erf(across / np.sqrt(2.0))
    return np.tile(row, (rows, 1))


def numbers(grey: NDArray[np.float64], valid: NDArray[np.bool_] | None = None) -> dict[str, float]:
    known = np.ones(grey.shape, dtype=np.bool_) if valid is None else valid
    image = GreyImage(grey=grey, valid=known, region=known)
    return {item.name: item.value for item in sharpness_findings(image, 3)}


def image(
    mask: NDArray[np.uint8], rgb: NDArray[np.uint8] | None = None, **known: object
) -> Orthoimage:
    plain = np.zeros((*FRAME.shape, 3), dtype=np.uint8) if rgb is None else rgb
    return samples.orthoimage(FRAME, name="wall", rgb=plain, mask=mask, **known)


def masked() -> NDArray[np.uint8]:
    """Return a mask with a quarter of the cells painted and a tenth filled."""
    mask = np.full(FRAME.shape, OrthoMask.NO_SURFACE, dtype=np.uint8)
    mask[:5] = OrthoMask.PAINTED
    mask[5:7] = OrthoMask.FILLED
    return mask


def wall(depth_m: NDArray[np.float32] | None = None) -> Wall:
    plain = np.zeros(FRAME.shape, dtype=np.float32)
    return samples.wall(FRAME, depth_m=plain if depth_m is None else depth_m)


def test_completeness_is_of_the_scanned_surface() -> None:
    depth = np.zeros(FRAME.shape, dtype=np.float32)
    depth[:, 10:] = np.nan
    depth[0, 0] = np.nan
    shown = image(masked())
    found = completeness(shown, wall(depth))
    assert (found.name, found.unit) == ("completeness", "1")
    assert found.value == pytest.approx((7 * 10 - 1) / (20 * 10 - 1))
    nothing = wall(np.full(FRAME.shape, np.nan, np.float32))
    assert completeness(shown, nothing).value == 0.0
    # The filled share is relative to the cells that are shown.
    (filled,) = quality_findings(shown, wall(), None)
    assert (filled.name, filled.value) == ("filled_share", pytest.approx(2.0 / 7.0))


def camera(cells_per_pixel: float, turn_deg: float = 0.0) -> ViewingCamera:
    """Return a distant camera to the right of the wall's normal.

    A pixel covers the given number of cells across a ray.
    """
    middle = FRAME.world_from_wall(np.array([[SIDE / 2, SIDE / 2]]))[0]
    turn = np.radians(turn_deg)
    centre = middle + 100.0 * np.array([np.sin(turn), -np.cos(turn), 0.0])
    return samples.aimed(centre, middle, 100.0 / (cells_per_pixel * GSD_M), (1000, 1000))


@pytest.mark.parametrize("turn_deg", [0.0, 60.0])
def test_a_flat_wall_is_stretched_by_the_cosine_of_the_view(turn_deg: float) -> None:
    made = image(np.full(FRAME.shape, OrthoMask.PAINTED, dtype=np.uint8), sources=("a.jpg",))
    spread = cells_per_pixel(made, wall(), ("a.jpg", camera(0.7, turn_deg)))
    assert len(spread) == SIDE * SIDE
    # The wall is 0.2 m wide and 100 m away, so perspective changes the value by 0.2 %.
    np.testing.assert_allclose(spread, 0.7 / np.cos(np.radians(turn_deg)), rtol=5e-3)


def test_only_cells_that_a_photo_painted_are_asked() -> None:
    mask = masked()
    source = np.zeros(FRAME.shape, dtype=np.int16)
    source[:2] = 1
    made = image(mask, source=source, sources=("a.jpg", "b.jpg"))
    view = camera(1.5)
    depth = np.zeros(FRAME.shape, dtype=np.float32)
    depth[4] = np.nan
    # Two of the painted rows are from the other photo, and one has no depth.
    assert len(cells_per_pixel(made, wall(depth), ("a.jpg", view))) == 2 * SIDE
    assert len(cells_per_pixel(made, wall(depth), ("b.jpg", view))) == 2 * SIDE
    assert len(cells_per_pixel(made, wall(depth), ("c.jpg", view))) == 0


@pytest.mark.parametrize(
    ("first", "last", "is_told"), [(0.09, 0.91, True), (0.11, 0.91, False), (0.09, 0.89, False)]
)
def test_a_spread_that_begins_or_ends_grey_tells_nothing(
    first: float, last: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ramp = np.linspace(0.0, 1.0, image_quality.PROFILE_PLACES.size)
    ramp[0], ramp[-1] = first, last
    monkeypatch.setattr(image_quality, "edge_profiles", lambda _: np.tile(ramp, (20, 1)))
    assert bool(numbers(edge())) == is_told


@pytest.mark.parametrize("sigma", [0.8, 2.5])
def test_blurred_edges_show_their_blur(sigma: float) -> None:
    # Bars 40 cells wide, slightly rotated so that edges are at any position between cells.
    rows, columns = np.mgrid[:400, :400]
    place = np.mod(columns + 0.13 * rows, 80.0)
    signed = np.where(place < 40.0, place - 20.0, 60.0 - place) / np.hypot(1.0, 0.13)
    grey = 120.0 + 60.0 * erf(signed / (sigma * np.sqrt(2.0)))
    found = numbers(grey + np.random.default_rng(1).normal(scale=1.0, size=grey.shape))
    assert found["n_edges"] >= 20
    # The 10 to 90 % width of a Gaussian edge is 2.563 sigma; its MTF is 1/2 at sqrt(ln 2 / 2) / (pi
    # sigma).
    assert found["edge_width_cells"] == pytest.approx(2.563 * sigma, rel=0.1)
    assert found["mtf50_per_cell"] == pytest.approx(0.1874 / sigma, rel=0.1)


def test_an_image_without_edges_has_no_sharpness() -> None:
    for shape in ((100, 100), (1, 1), (1, 30)):
        assert numbers(np.full(shape, 90.0)) == {}
    assert numbers(np.full((100, 100), 90.0), np.zeros((100, 100), dtype=np.bool_)) == {}
