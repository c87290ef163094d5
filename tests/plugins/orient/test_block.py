"""The adjustment of a block and its covariance, compared with independent solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.orient import block as adjustment
from orthoflow_plugins.orient.pose import Lens
from scipy.optimize import least_squares

from orthoflow.errors import GeometryError, MethodError
from orthoflow.geometry.cameras import LensFreedom, ViewingCamera, stepped
from orthoflow.products import Photo
from orthoflow.testing import photographed as ms
from tests import block_scenes as bs

SIGMA_PX = 0.3
FREEDOM = LensFreedom(focal_sigma=0.02, k1_sigma=0.05)


def block_of(
    *, freedoms: tuple[LensFreedom, ...] = (FREEDOM,), lens_of: tuple[int, ...] = (0, 0, 0)
) -> adjustment.Block:
    """Return three photos; a third of the points is seen once, a third is not in the scan."""
    rng = np.random.default_rng(0)
    cameras = bs.viewers()[:3]
    points = rng.uniform([0.6, -0.1, 0.4], [2.4, 0.1, 1.6], (45, 3))
    sigma_m = np.where(np.arange(45) < 30, 0.002, np.inf)
    known = points + np.where(np.arange(45) < 30, 0.002, 0.0)[:, None] * rng.normal(size=(45, 3))
    photo, point, exact = bs.observed(cameras, points)
    kept = point >= 15
    kept[np.unique(point, return_index=True)[1]] = True
    kept &= (point < 30) | (np.bincount(point)[point] > 1)
    photo, point, exact = photo[kept], point[kept], exact[kept]
    return adjustment.Block(
        cameras=cameras,
        lens_of=lens_of,
        lenses=tuple(
            Lens(prior=cameras[lens_of.index(k)], freedom=freedom, source="calibration")
            for k, freedom in enumerate(freedoms)
        ),
        points=adjustment.Points(now=points, known=known, sigma_m=sigma_m),
        seen=adjustment.Observations(
            photo=photo,
            point=point,
            pixels=exact + SIGMA_PX * rng.normal(size=exact.shape),
            sigma_px=np.full(len(exact), SIGMA_PX),
        ),
    )


def predicted(block: adjustment.Block, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels of all observations after a step of poses, lenses and points."""
    places = np.where(block.is_joint[:, None], block.points.now, block.points.known)
    places = places + unknowns[block.lens_starts[-1] :].reshape(-1, 3)
    pixels = np.empty_like(block.seen.pixels)
    for photo, camera in enumerate(block.cameras):
        mine, freedom = block.seen.photo == photo, block.lenses[block.lens_of[photo]].freedom
        moved = stepped(camera, unknowns[block.columns(photo)], freedom)
        pixels[mine] = moved.project(places[block.seen.point[mine]])[:, :2]
    return pixels


def by_differences(
    block: adjustment.Block, soft_limit: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cofactors of poses and lenses, and residuals, by differences of all unknowns at once.

    Residuals beyond `soft_limit` are weighted as by Huber; points seen once must not have such
    residuals.
    """
    n_free, points = int(block.lens_starts[-1]), block.points
    sigma_m = np.repeat(points.sigma_m, 3)
    steps = 1e-6 * np.eye(n_free + len(sigma_m))
    changes = [(predicted(block, step) - predicted(block, -step)) / 2e-6 for step in steps]
    off = (block.seen.pixels - predicted(block, np.zeros(len(steps)))) / SIGMA_PX
    weights = np.sqrt(np.minimum(1.0, soft_limit / np.linalg.norm(off, axis=1)))[:, None]
    jacobian = weights[..., None] * np.stack(changes, axis=-1) / SIGMA_PX
    priors = [1.0 / lens.freedom.sigmas for lens in block.lenses]
    held = np.diag(np.concatenate([np.zeros(6 * len(block.cameras)), *priors, 1.0 / sigma_m]))
    rows = np.vstack([jacobian.reshape(-1, len(steps)), held])
    rows = rows[:, rows.any(axis=0)]
    moved = np.where(block.is_joint[:, None], points.known - points.now, 0.0).ravel() / sigma_m
    residuals = np.concatenate([(weights * off).ravel(), np.zeros(n_free), moved])
    # Subtract the part of the residuals that the points absorb.
    residuals -= rows[:, n_free:] @ np.linalg.lstsq(rows[:, n_free:], residuals, rcond=None)[0]
    return np.linalg.inv(rows.T @ rows)[:n_free, :n_free], residuals


@pytest.mark.parametrize("soft_limit", [100.0, 0.7])
def test_cofactors_and_sigma0_are_those_of_all_unknowns_at_once(soft_limit: float) -> None:
    freedoms = (FREEDOM, LensFreedom(focal_sigma=0.01, centre_sigma_px=5.0))
    block = block_of(freedoms=freedoms, lens_of=(0, 1, 0))
    if soft_limit < 1.0:
        block = replace(block, seen=block.seen.take(block.is_joint[block.seen.point]))
    counts = np.bincount(block.seen.point)
    assert set(counts[:15]) == {1 if soft_limit > 1.0 else 0}
    assert (counts[30:] > 1).sum() > 5
    found = adjustment.block_covariance(block, soft_limit=soft_limit)
    expected, residuals = by_differences(block, soft_limit)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.cofactors / scale, expected / scale, atol=1e-5)
    # Each point that is not in the scan reduces the redundancy by three.
    prior = np.concatenate([1.0 / freedom.sigmas**2 for freedom in freedoms])
    learnt = float((np.diag(expected)[18:] * prior).sum())
    n_new = np.count_nonzero(counts[30:])
    redundancy = 2 * len(block.seen) - 3 * n_new - len(expected) + learnt
    assert found.redundancy == pytest.approx(redundancy, rel=1e-5)
    assert found.sigma0 == pytest.approx(np.sqrt((residuals**2).sum() / redundancy), rel=1e-4)
    # In no direction is the variance smaller than that of least squares.
    least = np.linalg.eigvals(np.linalg.solve(found.sigma0**2 * found.cofactors, found.matrix))
    assert least.real.min() > 1.0 - 1e-6


def minimised(block: adjustment.Block, soft_limit: float) -> list[NDArray[np.float64]]:
    """Return the camera centres that SciPy finds for the same problem, implemented separately."""
    joint = np.flatnonzero(block.is_joint)
    whitening = np.linalg.inv(np.linalg.cholesky(adjustment.pixel_covariances(block)))

    def residuals(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        moves = np.zeros((len(block.points), 3))
        moves[joint] = unknowns[18:].reshape(-1, 3)
        off = block.seen.pixels - predicted(block, np.append(unknowns[:18], moves))
        off = np.einsum("nij,nj->ni", whitening, off)
        lengths = np.linalg.norm(off, axis=1)
        # Its square is Huber's loss.
        large = lengths > soft_limit
        shrunk = np.sqrt(2.0 * soft_limit * lengths[large] - soft_limit**2) / lengths[large]
        off[large] *= shrunk[:, None]
        pulled = (block.points.now + moves - block.points.known) / block.points.sigma_m[:, None]
        return np.concatenate([off.ravel(), pulled[joint].ravel()])

    start = np.zeros(18 + 3 * len(joint))
    found = least_squares(residuals, start, x_scale="jac", xtol=1e-10, ftol=1e-10).x
    steps = [found[6 * at : 6 * at + 6] for at in range(3)]
    return [
        stepped(camera, step, LensFreedom()).centre_world
        for camera, step in zip(block.cameras, steps, strict=True)
    ]


def test_the_adjustment_finds_the_least_sum_of_huber_losses() -> None:
    block = block_of(freedoms=(LensFreedom(),))
    # Every fifteenth observation is off by ten standard deviations.
    block.seen.pixels[::15] += [8.0 * SIGMA_PX, -6.0 * SIGMA_PX]
    # Use few joint points, because SciPy differentiates by each of their coordinates.
    few = ~block.is_joint[block.seen.point] | (block.seen.point % 8 == 0)
    block = replace(block, seen=block.seen.take(few))
    solved = adjustment.solve(block, soft_limit=1.5)
    sigmas = np.sqrt(np.diag(adjustment.block_covariance(solved, soft_limit=1.5).matrix)).reshape(
        3, 6
    )
    for camera, sigma, expected in zip(solved.cameras, sigmas, minimised(block, 1.5), strict=True):
        # The solver stops at a hundredth of a standard deviation.
        off = np.linalg.norm(camera.centre_world - expected)
        assert off < 0.05 * np.linalg.norm(sigma[3:])


def test_too_few_observations_determine_no_block() -> None:
    block = block_of()
    few = replace(block, seen=block.seen.take(np.arange(12)))
    with pytest.raises(GeometryError, match="do not suffice to orient the block"):
        adjustment.block_covariance(few, soft_limit=3.0)


# --- reports on lenses ---


def photos() -> list[Photo]:
    return [Photo(name=f"{name}.png", encoded=b"", width=4, height=3) for name in "abc"]


def test_lenses_are_told_with_their_photos_and_deviations() -> None:
    block = block_of(freedoms=(FREEDOM, LensFreedom()), lens_of=(0, 1, 0))
    covariance = np.diag(np.arange(1.0, 21.0) ** 2)
    first, second = adjustment.lenses_json(block, photos(), covariance)  # type: ignore[misc]
    camera = block.cameras[0]
    assert first == {
        "photos": ["a.png", "c.png"],
        "known_from": "calibration",
        "focal_px": camera.fx,
        "centre_px": [camera.cx, camera.cy],
        "distortion": camera.distortion.tolist(),
        "free": ["focal", "k1"],
        # These are the 19th and the 20th unknown; focal lengths are logarithms.
        "sigmas": {"focal": pytest.approx(19.0 * camera.fx), "k1": pytest.approx(20.0)},
    }
    assert (second["photos"], second["free"], second["sigmas"]) == (["b.png"], [], {})


def test_lenses_of_one_size_have_a_mean_and_a_spread() -> None:
    block = block_of(freedoms=(FREEDOM, FREEDOM), lens_of=(0, 1, 0))
    first, other, third = block.cameras
    block = replace(block, cameras=(first, replace(other, fx=first.fx + 30.0), third))
    (entry,) = adjustment.lens_statistics(block)  # type: ignore[misc]
    assert entry["n_lenses"] == 2
    assert entry["mean"]["focal"] == pytest.approx(first.fx + 15.0)
    assert entry["sd"]["focal"] == pytest.approx(30.0 / np.sqrt(2.0))


def test_lenses_that_all_photos_confuse_with_their_pose_are_named() -> None:
    block = block_of()
    cofactors = np.eye(20)

    def correlate(photo: int, pose: int, lens: int, share: float) -> None:
        cofactors[6 * photo + pose, 18 + lens] = cofactors[18 + lens, 6 * photo + pose] = share

    for photo in range(2):
        correlate(photo, 5, 0, -0.97)
    assert adjustment.correlation_notes(block, photos(), cofactors) == []
    correlate(2, 5, 0, 0.94)
    assert adjustment.correlation_notes(block, photos(), cofactors) == []
    correlate(2, 5, 0, 0.96)
    scale = np.linspace(1.0, 3.0, 20)
    ((photo, (spec, values)),) = adjustment.correlation_notes(
        block, photos(), cofactors * np.outer(scale, scale)
    )
    assert (photo, spec.code) == ("a.png", "lens-correlated-with-pose")
    assert (values["parameter"], values["pose"]) == ("focal", "distance")
    assert values["correlation"] == pytest.approx(0.96)


TRUE = {"fx": 840.0, "fy": 882.0, "cx": 457.0, "cy": 315.0}
DISTORTION = np.array([-0.09, 0.03, 6e-4, -4e-4, 0.01])
# Loose priors, which the observations outweigh by far.
LOOSE = {"focal": 0.2, "aspect": 0.2, "centre_px": 60.0, "k1": 0.5, "k2": 0.5, "tangential": 0.05}


def true_cameras() -> tuple[ViewingCamera, ...]:
    return tuple(
        replace(camera, distortion=DISTORTION, **TRUE)  # type: ignore[arg-type]
        for camera in bs.viewers()[:3]
    )


def freedom(*names: str, times: float = 1.0) -> LensFreedom:
    of = {"centre_px": "centre_sigma_px"}
    return LensFreedom(
        **{of.get(name, f"{name}_sigma"): times * LOOSE[name] for name in names}  # type: ignore[arg-type]
    )


def lens_block(
    believed: dict[str, float], distortion: np.ndarray, free: LensFreedom, *, moved_m: float = 0.01
) -> adjustment.Block:
    """Return exact observations by displaced cameras with a wrong lens."""
    true = true_cameras()
    points = np.random.default_rng(3).uniform([0.4, -0.6, 0.3], [2.6, 0.1, 1.7], (90, 3))
    photo, point, pixels = bs.observed(true, points)
    # Each point of the scan is seen once, so there is a separate point for each observation.
    own = np.arange(len(photo))
    cameras = tuple(
        replace(
            ms.nudged(camera, (0.002, -0.001, 0.002, moved_m, -moved_m, moved_m)),
            distortion=distortion,
            **believed,  # type: ignore[arg-type]
        )
        for camera in true
    )
    known = points[point]
    return adjustment.Block(
        cameras=cameras,
        lens_of=(0, 0, 0),
        lenses=(Lens(prior=cameras[0], freedom=free, source="exif"),),
        points=adjustment.Points(now=known, known=known, sigma_m=np.full(len(own), 1e-5)),
        seen=adjustment.Observations(
            photo=photo, point=own, pixels=pixels, sigma_px=np.full(len(own), 0.1)
        ),
    )


@pytest.mark.parametrize(
    ("names", "off", "distortion_off"),
    [
        ((), {}, (0.0,) * 4),
        # The ratio of the focal lengths does not change.
        (("focal",), {"fx": 1.02, "fy": 1.02}, (0.0,) * 4),
        (("k1",), {}, (0.02, 0.0, 0.0, 0.0)),
        (
            ("focal", "aspect", "centre_px", "k1", "k2", "tangential"),
            {"fx": 1.02, "fy": 1.01, "cx": 1.01, "cy": 0.99},
            (0.01, -0.01, 3e-4, 3e-4),
        ),
    ],
)
def test_what_is_free_of_a_lens_is_found_and_the_rest_stays(
    names: tuple[str, ...], off: dict[str, float], distortion_off: tuple[float, ...]
) -> None:
    believed = {name: off.get(name, 1.0) * value for name, value in TRUE.items()}
    distortion = DISTORTION + np.array([*distortion_off, 0.0])
    solved = adjustment.solve(lens_block(believed, distortion, freedom(*names)), soft_limit=3.0)
    for found, camera in zip(solved.cameras, true_cameras(), strict=True):
        for name, value in TRUE.items():
            assert getattr(found, name) == pytest.approx(value, abs=0.05), name
        np.testing.assert_allclose(found.distortion, DISTORTION, atol=5e-5)
        assert found.distortion[4] == DISTORTION[4]
        np.testing.assert_allclose(found.centre_world, camera.centre_world, atol=2e-4)
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-14)


def test_what_is_known_of_a_lens_beforehand_holds_it() -> None:
    off = {"fx": 1.02, "fy": 1.02, "cx": 1.02, "cy": 0.98}
    believed = {key: off[key] * value for key, value in TRUE.items()}
    distortion = DISTORTION + np.array([0.02, 0.02, 5e-4, 5e-4, 0.0])
    sure = freedom("focal", "centre_px", "k1", "k2", "tangential", times=1e-6)
    found = adjustment.solve(lens_block(believed, distortion, sure), soft_limit=3.0).cameras[0]
    for key, value in believed.items():
        assert getattr(found, key) == pytest.approx(value, abs=0.01), key
    np.testing.assert_allclose(found.distortion, distortion, atol=1e-5)


def test_a_lens_with_skew_is_refused() -> None:
    block = lens_block(TRUE, DISTORTION, LensFreedom())
    skewed = tuple(replace(camera, skew=2.0) for camera in block.cameras)
    with pytest.raises(MethodError, match=r"has a skew of 2\.0 px"):
        adjustment.solve(replace(block, cameras=skewed), soft_limit=3.0)
