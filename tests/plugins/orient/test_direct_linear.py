"""Projection matrices taken apart, and how much control eleven parameters and a lens need."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import direct_linear
from orthoflow_plugins.orient.direct_linear import Distortion, Relief, estimate_dlt, relief
from orthoflow_plugins.orient.estimation import Estimate, EstimationRule

from orthoflow.errors import GeometryError
from orthoflow.geometry.cameras import ViewingCamera, looking_at
from orthoflow.geometry.resection import SeenPoints
from orthoflow.geometry.rotations import rotation_from_vector
from orthoflow.products import Intrinsics, Photo
from tests import samples

SIZE_PX = (4000, 3000)
RULE = EstimationRule(rejection_sigma=3.5, threshold_px=None, n_trials_most=500, seed=1)


def camera(**changes: object) -> ViewingCamera:
    centre = np.array([0.15, -2.6, 0.1])
    rotation = looking_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    plain = {"fx": 3200.0, "fy": 3204.0, "cx": 2012.0, "cy": 1490.0}
    return samples.camera(
        rotation, centre, width=SIZE_PX[0], height=SIZE_PX[1], **{**plain, **changes}
    )


def seen_by(
    viewer: ViewingCamera, n: int, *, relief_m: float = 0.3, sigma_m: float = 1e-5, seed: int = 1
) -> SeenPoints:
    """Exact ties all over the photo, on two planes so far apart."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([100.0, 100.0], [3900.0, 2900.0], (n, 2))
    rays = viewer.rays_world(pixels)
    depth = np.where(np.arange(n) % 2 == 0, 0.0, -relief_m)
    reach = (depth - viewer.centre_world[1]) / rays[:, 1]
    return SeenPoints(
        pixels_photo=pixels,
        points_world=viewer.centre_world + reach[:, None] * rays,
        sigma_px=np.full(n, 0.5),
        sigma_m=np.full(n, sigma_m),
    )


def estimated(
    viewer: ViewingCamera,
    seen: SeenPoints,
    *,
    distortion: Distortion = "none",
    keeps_skew: bool = False,
    is_check: NDArray[np.bool_] | None = None,
) -> Estimate | str:
    photo = Photo(
        name="a.png",
        encoded=b"",
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        intrinsics=Intrinsics.of(viewer),
    )
    withheld = np.zeros(len(seen), dtype=np.bool_) if is_check is None else is_check
    return estimate_dlt(photo, seen, withheld, RULE, distortion=distortion, keeps_skew=keeps_skew)


@pytest.mark.parametrize("scale", [1.0, -3.0, 0.02])
@pytest.mark.parametrize("seed", range(4))
def test_a_projection_matrix_comes_apart_into_what_it_was_made_of(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    rotation = rotation_from_vector(rng.normal(size=3))
    translation = rng.normal(size=3)
    lens = np.array([[3000.0, 25.0, 2010.0], [0.0, 2800.0, 1480.0], [0.0, 0.0, 1.0]])
    # In front of the camera, five metres away and more.
    local = rng.uniform([-2.0, -2.0, 5.0], [2.0, 2.0, 9.0], (12, 3))
    points = (local - translation) @ rotation
    matrix = scale * lens @ np.column_stack([rotation, translation])
    found = direct_linear._decomposed(matrix, points, SIZE_PX)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9)
    assert (found.fx, found.fy) == pytest.approx((3000.0, 2800.0))
    assert (found.cx, found.cy, found.skew) == pytest.approx((2010.0, 1480.0, 25.0))
    assert (found.width, found.height) == SIZE_PX
    with pytest.raises(GeometryError, match="puts the points behind the camera"):
        direct_linear._decomposed(matrix, (-local - translation) @ rotation, SIZE_PX)


def test_normalised_points_lie_about_the_origin_at_the_length_asked_for() -> None:
    values = np.random.default_rng(3).normal(5.0, 40.0, (50, 3))
    shift, scale = direct_linear._normalisation(values, 1.7)
    moved = (values - shift) * scale
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=1e-12)
    assert np.linalg.norm(moved, axis=1).mean() == pytest.approx(1.7)


def test_relief_is_told_across_and_along_the_best_plane() -> None:
    points = np.array([[x, y, z] for x in (-3.0, 3.0) for y in (-1.0, 1.0) for z in (-0.2, 0.2)])
    turn = rotation_from_vector(np.array([0.3, -0.5, 0.2]))
    found = relief(points @ turn.T + [100.0, 200.0, 300.0])
    assert found == Relief(
        rms_m=pytest.approx(0.2, abs=1e-9),  # type: ignore[arg-type]
        extent_m=pytest.approx(3.0, abs=1e-9),  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    ("distortion", "keeps_skew", "least"),
    [
        ("none", False, 12),
        ("none", True, 13),
        ("k1", False, 16),
        ("k1 k2 p1 p2", False, 24),
        ("k1 k2 p1 p2", True, 25),
    ],
)
def test_a_richer_lens_needs_more_control(
    distortion: Distortion, keeps_skew: bool, least: int
) -> None:
    viewer = camera()
    enough, few = (
        estimated(viewer, seen_by(viewer, n), distortion=distortion, keeps_skew=keeps_skew)
        for n in (least, least - 1)
    )
    assert isinstance(enough, Estimate)
    assert isinstance(few, str)
    assert f"only {least - 1} control ties" in few
    assert f"needs {least}" in few
    # Withheld ties are no control.
    is_check = np.arange(least) == 3
    held = estimated(
        viewer,
        seen_by(viewer, least),
        distortion=distortion,
        keeps_skew=keeps_skew,
        is_check=is_check,
    )
    assert isinstance(held, str)


@pytest.mark.parametrize(("sigma_m", "is_enough"), [(0.0048, True), (0.0053, False)])
def test_relief_must_be_ten_deviations_of_the_points(sigma_m: float, is_enough: bool) -> None:
    viewer = camera()
    # Two planes 10 cm apart: 5 cm from the one between them, nearly.
    seen = seen_by(viewer, 80, relief_m=0.1, sigma_m=sigma_m)
    assert relief(seen.points_world).rms_m == pytest.approx(0.05, rel=0.02)
    found = estimated(viewer, seen)
    assert isinstance(found, Estimate) == is_enough
    if isinstance(found, str):
        assert "a DLT needs 10 times as much relief" in found


def test_exact_ties_give_the_exact_camera() -> None:
    viewer = camera()
    found = estimated(viewer, seen_by(viewer, 60))
    assert isinstance(found, Estimate)
    near = found.resection.camera
    assert (near.fx, near.fy, near.cx, near.cy) == pytest.approx(
        (3200.0, 3204.0, 2012.0, 1490.0), abs=0.1
    )
    np.testing.assert_allclose(near.centre_world, viewer.centre_world, atol=1e-4)
    assert found.numbers["skew_px"] == pytest.approx(0.0, abs=0.05)
    assert 1.0 < found.numbers["condition"] < 1000.0
    assert found.source == "dlt"


def test_skew_is_given_whether_it_is_kept_or_not() -> None:
    viewer = camera(skew=4.0)
    seen = seen_by(viewer, 60)
    for keeps_skew, kept_px in ((True, 4.0), (False, 0.0)):
        found = estimated(replace(viewer, skew=0.0), seen, keeps_skew=keeps_skew)
        assert isinstance(found, Estimate)
        assert found.numbers["skew_px"] == pytest.approx(4.0, abs=0.1)
        assert found.resection.camera.skew == pytest.approx(kept_px, abs=0.1)


def test_points_behind_a_grid_over_the_photo_are_as_far_as_the_control_near_them() -> None:
    viewer = camera()
    seen = seen_by(viewer, 200)
    points = direct_linear._frame_points(viewer, seen)
    pixels = viewer.project(points)[:, :2]
    steps = (np.arange(12) + 0.5) / 12
    expected = np.stack(np.meshgrid(steps * 4000.0, steps * 3000.0), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(pixels, expected, atol=1e-6)
    ranges = np.linalg.norm(seen.points_world - viewer.centre_world, axis=1)
    apart = np.linalg.norm(expected[:, None] - seen.pixels_photo[None], axis=2)
    np.testing.assert_allclose(
        np.linalg.norm(points - viewer.centre_world, axis=1), ranges[apart.argmin(axis=1)]
    )


def test_moves_are_told_from_the_first_camera_to_the_other() -> None:
    viewer = camera()
    points = seen_by(viewer, 30).points_world
    moved = direct_linear._moved_px(
        viewer, replace(viewer, cx=viewer.cx + 3.0, cy=viewer.cy - 4.0), points
    )
    np.testing.assert_allclose(moved, np.tile([3.0, -4.0], (30, 1)), atol=1e-9)
    assert direct_linear._mean_square(moved) == pytest.approx(12.5)


@pytest.mark.parametrize(("k1", "is_said"), [(0.0, False), (-0.08, True)])
def test_a_lens_that_bends_more_than_the_model_is_said(k1: float, is_said: bool) -> None:
    viewer = camera(distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]))
    seen = seen_by(viewer, 200)
    noise = np.random.default_rng(7).normal(0.0, 0.5, (200, 2))
    found = estimated(
        replace(viewer, distortion=np.zeros(5)),
        replace(seen, pixels_photo=seen.pixels_photo + noise, sigma_px=np.full(200, 5.0)),
    )
    assert isinstance(found, Estimate)
    assert any("its lens has distortion that a DLT" in note for note in found.notes) == is_said


def flat(n: int, *, relief_m: float, sigma_m: float, width_m: float = 2.0) -> SeenPoints:
    """Ties on a plane 2 m wide and half as high, every second one off it."""
    rng = np.random.default_rng(6)
    points = rng.uniform(-0.5, 0.5, (n, 3)) * [width_m, 0.0, 0.5 * width_m]
    points[:, 1] = relief_m * np.where(np.arange(n) % 2 == 0, -1.0, 1.0)
    return SeenPoints(
        pixels_photo=np.zeros((n, 2)),
        points_world=points,
        sigma_px=np.ones(n),
        sigma_m=np.full(n, sigma_m),
    )


@pytest.mark.parametrize(
    ("relief_m", "sigma_m", "said"),
    [
        (0.01, 0.0005, ""),
        (0.01, 0.0011, "its points are known to 1.1 mm, and a DLT needs 10 times as much relief"),
        # A five thousandth of what they extend along their longer axis, 0.577 m.
        (0.00013, 0.0, ""),
        (0.0001, 0.0, "a DLT needs relief"),
    ],
)
def test_control_too_near_a_plane_is_told_why(relief_m: float, sigma_m: float, said: str) -> None:
    control = flat(4000, relief_m=relief_m, sigma_m=sigma_m)
    reason = direct_linear._too_flat(control)
    assert bool(reason) == bool(said)
    if said:
        assert f"within {1000 * relief_m:.1f} mm (RMS) of one plane; {said}: use" in reason


def test_equations_of_bad_condition_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = camera()
    seen = seen_by(viewer, 60)
    found = direct_linear.direct_linear(seen.pixels_photo, seen.points_world, SIZE_PX)
    for most, is_fine in ((1.01 * found.condition, True), (0.99 * found.condition, False)):
        monkeypatch.setattr(direct_linear, "_CONDITION_MOST", most)
        said = estimated(viewer, seen)
        assert isinstance(said, Estimate) == is_fine
    assert isinstance(said, str)
    assert f"the equations have condition {found.condition:.0f}: use orient.pnp" in said


def test_five_points_and_points_in_one_place_determine_no_camera() -> None:
    seen = seen_by(camera(), 6)
    direct_linear.direct_linear(seen.pixels_photo, seen.points_world, SIZE_PX)
    with pytest.raises(GeometryError, match="needs six points, got 5"):
        direct_linear.direct_linear(seen.pixels_photo[:5], seen.points_world[:5], SIZE_PX)
    with pytest.raises(GeometryError, match="lie in one place"):
        direct_linear._normalisation(np.ones((7, 2)), 1.0)


def test_ties_without_a_pose_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct_linear, "robust_start", lambda *_: None)
    assert estimated(camera(), seen_by(camera(), 60)) == "no pose agrees with enough of its 60 ties"


@pytest.mark.parametrize(
    ("sigma0", "factor", "is_said"),
    [(1.0, 1.0, False), (1.49, 2.2, False), (1.51, 1.0, True), (1.0, 2.3, True)],
)
def test_what_a_lens_model_lacks_is_said_from_half_as_much_again(
    sigma0: float, factor: float, is_said: bool
) -> None:
    estimate: Any = SimpleNamespace(resection=SimpleNamespace(sigma0=sigma0))
    notes = direct_linear._misfit_notes(estimate, 4.0, factor)
    assert bool(notes) == is_said
    if is_said:
        assert f"deviate {sigma0:.1f} times" in notes[0]
        assert "would move its points by 2.0 px" in notes[0]
        assert f"the stated error is {np.sqrt(factor):.1f} times as large" in notes[0]


def test_a_fuller_lens_that_cannot_be_found_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float] = []

    def fail(*_: object, soft_limit: float, **__: object) -> None:
        limits.append(soft_limit)
        raise GeometryError("the ties do not determine the camera")

    monkeypatch.setattr(direct_linear, "adjust", fail)
    found = estimated(camera(), seen_by(camera(), 60))
    assert isinstance(found, Estimate)
    assert found.notes == ()
    # Ties without any error would all lie beyond limits as fine as they are.
    assert set(limits) == {direct_linear.SOFT_LIMIT}
