"""Figures of an orientation: ties on photos, predicted errors on walls, residuals of photos."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import report
from orthoflow_plugins.orient.gates import KnownWall

from orthoflow.files.drawing import COLUMN_INCHES
from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Camera, Photo, TieRole
from tests import samples
from tests.tied_photos import context


def residuals(name: str, n: int, seed: int, *, shift_px: float = 0.0) -> report.Oriented:
    rng = np.random.default_rng(seed)
    role = np.where(np.arange(n) % 5 == 0, TieRole.CHECK, TieRole.CONTROL).astype(np.uint8)
    role[-1] = TieRole.REJECTED
    values = rng.normal(shift_px, 0.5, (n, 2))
    values[-1] = 1e6
    camera = Camera(photo=name, status="ok")
    return report.Oriented(camera=camera, chosen=np.arange(n), role=role, residuals_px=values)


# --- ties on photos ---


def photo_of(image: NDArray[np.uint8], name: str = "west/a b.jpg") -> Photo:
    return Photo(name=name, encoded=encode_png(image), width=image.shape[1], height=image.shape[0])


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_ties_are_marked_on_a_dimmed_photo_in_the_colour_of_their_role(
    scale: float, drawings: dict[str, Any], tmp_path: Path
) -> None:
    image = np.full((round(300 / scale), round(900 / scale), 3), 200, dtype=np.uint8)
    at = np.array([[100.5, 50.5], [400.5, 100.5], [700.5, 250.5]])
    role = np.array([TieRole.CONTROL, TieRole.CHECK, TieRole.REJECTED], dtype=np.uint8)
    report.draw_ties(context(tmp_path), photo_of(image), at / scale, role, "ok")
    drawn = drawings["ties_west-a-b"]
    assert decode_image(drawn(), "ties").shape[1] == 1003
    shown, counts = drawn.args
    assert list(counts.values()) == [1, 1, 1]
    assert shown.shape == (300, 900, 3)
    colours = [(40, 200, 60), (250, 220, 40), (220, 40, 40)]
    for (u, v), colour in zip(((100, 50), (400, 100), (700, 250)), colours, strict=True):
        # Discs with a radius of two pixels.
        for du, dv in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
            assert tuple(shown[v + dv, u + du]) == colour
        for du, dv in ((4, 0), (-4, 0), (0, 4), (0, -4)):
            assert tuple(shown[v + dv, u + du]) == (140, 140, 140)


def test_photos_of_one_stem_have_figures_of_their_own_and_no_more_than_enough(
    tmp_path: Path,
) -> None:
    ctx, image = context(tmp_path), np.zeros((4, 6, 3), dtype=np.uint8)
    names = ["a.jpg", "a.tif", "noending", *(f"{k}.jpg" for k in range(30))]
    for name in names:
        report.draw_ties(ctx, photo_of(image, name), np.empty((0, 2)), np.empty(0, np.uint8), "ok")
    found = [figure.name for figure in ctx.figures]
    assert found[:3] == ["ties_a", "ties_a-1", "ties_noending"]
    assert len(found) == 24


# --- predicted errors ---


def wall_of(left: float, right: float, *, number: int = 0) -> KnownWall:
    """Return a 2 m high wall in the plane y = 0."""
    corners = [[left, 0.0, 2.0], [left, 0.0, 0.0], [right, 0.0, 0.0], [right, 0.0, 2.0]]
    return KnownWall(
        index=number,
        number=number,
        name=f"wall {number}",
        corners_world=np.array(corners),
        normal=-samples.NORTH,
        gsd_m=None,
        has_side=True,
    )


def test_the_map_of_a_wall_shows_the_photo_that_knows_each_place_best(
    drawings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall, hidden, shape = wall_of(0.0, 9.0, number=8), wall_of(0.0, 9.0, number=9), (20, 90)
    sigmas = np.random.default_rng(0).uniform(0.001, 0.01, (2, *shape))
    sigmas[0, :5], sigmas[1, 3:, :4] = np.inf, np.nan

    def sigmas_of(photo: int, on: Any, asked: tuple[int, int]) -> NDArray[np.float64]:
        assert asked == shape
        return sigmas[photo] if on is wall else np.full(shape, np.inf)

    monkeypatch.setattr(report, "sigmas_on_wall", sigmas_of)
    candidates: Any = [
        SimpleNamespace(known=(wall, hidden), estimate=SimpleNamespace(resection=k)) for k in (0, 1)
    ]
    report.draw_wall_errors(context(tmp_path), candidates)
    # No photo shows the other wall.
    assert list(drawings) == ["wall_8_predicted_error"]
    best = np.fmin(*np.where(np.isfinite(sigmas), sigmas, np.nan))
    assert np.isnan(best).any()
    drawn = drawings["wall_8_predicted_error"]
    np.testing.assert_array_equal(drawn.args[0], 1e3 * best)
    # The limit is 1, 2 or 5 times a power of ten, so that maps to be compared have the same scale.
    assert drawn.keywords == {"low": 0.0, "high": 10.0}
    assert 5.0 < 1e3 * np.nanpercentile(best, 98.0) <= 10.0
    assert decode_image(drawn(), "map").shape[1] == 1003


# --- positions of photos ---


def test_photos_stand_before_the_wall_and_look_at_it(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    # The view is from 3 m in front of the wall, 3 m along it and 0.5 m below its upper edge, in the
    # direction -n.
    looks = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    camera = SimpleNamespace(centre_world=np.array([4.0, -3.0, 1.5]), rotation=looks)
    points = np.array([[2.0, 0.0, 1.0], [3.0, -0.1, 0.5], [8.0, 0.0, 1.9]])
    candidate: Any = SimpleNamespace(
        known=(wall_of(1.0, 9.0),),
        estimate=SimpleNamespace(resection=SimpleNamespace(camera=camera)),
        seen=SimpleNamespace(points_world=points),
        control=np.array([True, True, False]),
        photo=SimpleNamespace(name="a.jpg"),
    )
    report.draw_positions(context(tmp_path), [candidate])
    above, facing = drawings["positions"].axes
    (name,) = facing.texts
    assert (name.get_text(), *name.xy) == ("a.jpg", pytest.approx(3.0), pytest.approx(0.5))
    for panel, control in ((above, [[1, 0], [2, 0.1]]), (facing, [[1, 1], [2, 1.5]])):
        np.testing.assert_allclose(panel.lines[1].get_xydata(), control, atol=1e-12)
    # The arrow points down in the view from above.
    (arrow,) = above.patches
    assert arrow.get_xy()[:, 1].min() < 2.65
    assert facing.yaxis_inverted()


# --- residuals ---


def test_residuals_of_all_photos_are_counted_by_role_and_coordinate(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    photos = [residuals(f"{k}.jpg", 300, k, shift_px=k - 1.0) for k in range(3)]
    # Unknown residuals are omitted.
    photos[0].residuals_px[1] = np.nan
    report.draw_residuals(context(tmp_path), photos)
    pooled = drawings["residuals"]
    assert pooled.get_size_inches()[0] == pytest.approx(COLUMN_INCHES)
    panels = np.array(pooled.axes).reshape(2, 2)
    # All panels have the same scale.
    reach = panels[0, 0].patches[0].get_data()[1][-1]
    for row, kind, n in zip(panels, (TieRole.CONTROL, TieRole.CHECK), (716, 180), strict=True):
        values = np.vstack([photo.residuals_of(kind) for photo in photos])
        assert len(values) == n
        assert row[0].get_ylabel() == "ties per bar"
        for axes, column in zip(row, values.T, strict=True):
            counts, edges, _ = axes.patches[0].get_data()
            expected = np.histogram(column, bins=40, range=(-reach, reach))
            np.testing.assert_array_equal(counts, expected[0])
            np.testing.assert_allclose(edges, expected[1])


def test_the_density_of_residuals_shows_lobes(drawings: dict[str, Any], tmp_path: Path) -> None:
    photos = [residuals(f"{k}.jpg", 400, k, shift_px=3.0 * k) for k in range(2)]
    report.draw_residuals(context(tmp_path), photos)
    normal, density = drawings["residuals"].axes[0].lines

    def n_peaks(line: Any) -> int:
        curve = np.asarray(line.get_ydata())
        is_peak = (curve[1:-1] > curve[:-2]) & (curve[1:-1] > curve[2:])
        return int(np.count_nonzero(is_peak & (curve[1:-1] > 0.2 * curve.max())))

    assert (n_peaks(normal), n_peaks(density)) == (1, 2)
