"""Reports of an orientation: table of residuals, ties on photos, predicted errors, positions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import report
from orthoflow_plugins.orient.pnp import OrientPnp
from orthoflow_plugins.orient.report import residual_rows

from orthoflow.files.drawing import COLUMN_INCHES
from orthoflow.files.images import decode_image, encode_png
from orthoflow.products import Camera, Photo, TieRole
from orthoflow.testing import photographed as ms
from tests import tied_photos as tp
from tests.tied_photos import context

UNITS = {"px": 1.0, "mm": 2.5, "cell": 0.5}


def rows(residuals: np.ndarray, units: dict[str, float] = UNITS) -> dict[tuple[str, str], dict]:
    found = residual_rows("a", "check", residuals, units)
    return {(row.axis, row.unit): asdict(row) for row in found}


def test_numbers_are_those_of_their_definition() -> None:
    residuals = np.array([[1.0, 0.0], [-1.0, 0.0], [3.0, 2.0], [-1.0, 0.0], [-2.0, -2.0]])
    found = rows(residuals)["u", "px"]
    # u: mean 0, squares 1 + 1 + 9 + 1 + 4 = 16, cubes 1 - 1 + 27 - 1 - 8 = 18.
    assert found["n"] == 5
    assert found["mean"] == 0.0
    assert found["shift_p"] == 1.0
    assert found["sd"] == 2.0
    assert found["median"] == -1.0
    # Distances from the median: 2, 0, 4, 0, 1.
    assert found["nmad"] == pytest.approx(1.4826)
    assert found["skewness"] == pytest.approx((18.0 / 5.0) / (16.0 / 5.0) ** 1.5)
    assert found["rmse"] == pytest.approx(np.sqrt(3.2))
    assert found["p95"] == pytest.approx(2.8)
    assert found["max"] == 3.0


def test_shares_follow_their_three_conventions() -> None:
    residuals = np.zeros((20, 2))
    residuals[0, 0] = 5.0  # u: RMSE 1.118, so beyond; 5 px are 2.5 cells, so beyond
    residuals[1, 1] = 3.0  # v: RMSE 0.671, so beyond; 3 px are 1.5 cells, so not
    found = rows(residuals)
    assert (found["u", "px"]["beyond_own"], found["v", "px"]["beyond_own"]) == (0.05, 0.05)
    assert (found["u", "px"]["beyond_cells"], found["v", "px"]["beyond_cells"]) == (0.05, 0.0)
    assert found["u", "px"]["beyond_any"] == found["v", "px"]["beyond_any"] == 0.1


def test_an_orientation_is_recorded_with_its_lens_its_errors_and_its_residuals(
    tmp_path: Path,
) -> None:
    camera = ms.camera_before()
    photos = ms.photos(tp.photo(exif_focal_px=1.01 * camera.fx))
    ties = tp.known_ties(camera, 2, wrong_share=0.2)
    found = tp.oriented(OrientPnp, ties, photos, tp.context(tmp_path))
    (oriented,), role = found.cameras, found.ties.role
    viewing = oriented.viewing()
    entry = found.details["photos"]["a.png"]
    counts = [int((role == kind).sum()) for kind in TieRole]
    assert [entry[name] for name in ("n_control", "n_check", "n_rejected")] == counts
    assert counts[2] >= 40
    depths_m, pixel_mm = viewing.project(ties.points_world[role == 0])[:, 2], entry["pixel_mm"]
    assert pixel_mm == pytest.approx(1000.0 * np.median(depths_m) / viewing.fx, rel=0.03)
    assert (entry["lens"], entry["focal_px"]) == ("exif", viewing.fx)
    assert entry["k1"] == viewing.distortion[0]
    assert entry["sigma_wall_mm"] == 1000.0 * oriented.sigma_wall_m < entry["sigma_wall_worst_mm"]
    # The factor includes the common errors of the ties.
    assert entry["variance_factor"] > entry["sigma0"] ** 2
    assert abs(viewing.fx / camera.fx - 1.0) < 4.0 * entry["focal_sigma_px"] / viewing.fx < 0.1
    table = {(row.role, row.axis, row.unit): row for row in found.residual_table}
    factors = {"px": 1.0, "mm": pixel_mm, "cell": pixel_mm / (1000.0 * ms.GSD_M)}
    for kind in (TieRole.CONTROL, TieRole.CHECK):
        largest = np.abs(found.ties.residual_px[role == kind]).max(axis=0)
        for axis, longest in zip("uv", largest, strict=True):
            for unit, factor in factors.items():
                row = table.pop((kind.name.lower(), axis, unit))
                assert (row.photo, row.n) == ("a.png", counts[kind])
                assert row.max == pytest.approx(longest * factor)
    assert not table


def test_numbers_that_nothing_determines_are_none() -> None:
    found = rows(np.ones((3, 2)), {"px": 1.0})["u", "px"]
    assert (found["beyond_cells"], found["skewness"], found["shift_p"]) == (None, None, 0.0)
    assert rows(np.array([[0.5, -0.5]]))["u", "px"]["shift_p"] is None
    assert residual_rows("a", "check", np.empty((0, 2)), UNITS) == []


# --- figures ---


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


# --- predicted errors ---


def test_the_map_of_a_wall_shows_the_photo_that_knows_each_place_best(
    drawings: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall, hidden, shape = (
        tp.known_wall((0.0, 9.0), number=8),
        tp.known_wall((0.0, 9.0), number=9),
        (20, 90),
    )
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
        known=(tp.known_wall((1.0, 9.0)),),
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


def test_residuals_of_all_photos_are_counted_by_role_and_coordinate_and_show_lobes(
    drawings: dict[str, Any], tmp_path: Path
) -> None:
    photos = [residuals(f"{k}.jpg", 400, k, shift_px=3.0 * k) for k in range(2)]
    # Unknown residuals are omitted.
    photos[0].residuals_px[1] = np.nan
    report.draw_residuals(context(tmp_path), photos)
    pooled = drawings["residuals"]
    assert pooled.get_size_inches()[0] == pytest.approx(COLUMN_INCHES)
    panels = np.array(pooled.axes).reshape(2, 2)
    # All panels have the same scale.
    reach = panels[0, 0].patches[0].get_data()[1][-1]
    for row, kind, n in zip(panels, (TieRole.CONTROL, TieRole.CHECK), (637, 160), strict=True):
        values = np.vstack([photo.residuals_of(kind) for photo in photos])
        assert len(values) == n
        assert row[0].get_ylabel() == "ties per bar"
        for axes, column in zip(row, values.T, strict=True):
            counts, edges, _ = axes.patches[0].get_data()
            expected = np.histogram(column, bins=40, range=(-reach, reach))
            np.testing.assert_array_equal(counts, expected[0])
            np.testing.assert_allclose(edges, expected[1])
            # The density has a peak for each photo, the normal distribution one.
            for line, n_peaks in zip(axes.lines, (1, 2), strict=True):
                curve = np.asarray(line.get_ydata())
                is_peak = (curve[1:-1] > curve[:-2]) & (curve[1:-1] > curve[2:])
                assert np.count_nonzero(is_peak & (curve[1:-1] > 0.2 * curve.max())) == n_peaks
