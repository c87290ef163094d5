"""`plane.ransac`: scores, models, its own tolerance, and no misses in many seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.ransac import (
    Ransac,
    curve_order,
    draw_hypotheses,
    fewest_false_alarms,
)
from pydantic import ValidationError

from orthoflow.geometry import angle_between_deg
from orthoflow.products import PointCloud
from orthoflow.sdk import StepContext
from tests.long_loops import IS_LONG
from tests.plane_scenes import ROOM, cloud_of, sampled

STATION = np.array([[0.3, -0.2, 0.1]])
UP = np.array([0.0, 0.0, 1.0])


def detect(
    cloud: PointCloud, folder: Path, *, seed: int = 0, cores: int = 1, **params: Any
) -> tuple[Ransac.Out, StepContext]:
    folder.mkdir(parents=True, exist_ok=True)
    ctx = StepContext(rng=np.random.default_rng(seed), cores=cores, scratch=folder)
    return Ransac().run(Ransac.In(cloud=cloud), Ransac.Params(**params), ctx), ctx


def histogram_of(distances_m: NDArray[np.float64], reach_m: float) -> NDArray[np.int32]:
    return np.histogram(np.abs(distances_m), bins=100, range=(0.0, reach_m))[0][None].astype(
        np.int32
    )


@pytest.mark.longer
@pytest.mark.parametrize("seed", range(50 if IS_LONG else 2))
def test_no_seed_misses_a_wall(seed: int, tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(seed=seed), stations=STATION), tmp_path, seed=seed)[0].planes
    for truth in ROOM[:6]:
        misses = np.abs(planes.normal @ np.array(truth.centre) - planes.offset)
        index = int(np.argmin(misses + (np.abs(planes.normal @ truth.normal) < 0.99)))
        angle = angle_between_deg(planes.normal[index], truth.normal)
        assert min(angle, 180.0 - angle) < 0.02
        assert misses[index] < 2e-4


def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads(tmp_path: Path) -> None:
    cloud = cloud_of(sampled())
    one, three = (detect(cloud, tmp_path / str(n), cores=n)[0] for n in (1, 3))
    np.testing.assert_array_equal(one.labels.plane_index, three.labels.plane_index)
    for name in ("normal", "offset", "corners", "covariance", "rms_m"):
        np.testing.assert_array_equal(getattr(one.planes, name), getattr(three.planes, name))


def test_the_plan_model_finds_the_walls_and_lets_them_lean(tmp_path: Path) -> None:
    planes = detect(cloud_of(sampled(), stations=STATION), tmp_path, model="2d")[0].planes
    assert len(planes) == 4
    assert abs(planes.normal[0] @ UP) == pytest.approx(np.sin(np.radians(0.4)), abs=2e-4)
    raw = np.array([item["normal"] for item in planes.details["raw"]])
    np.testing.assert_allclose(raw @ UP, 0.0, atol=1e-9)


def test_the_plan_model_refuses_to_look_for_levels() -> None:
    with pytest.raises(ValidationError, match="model: 2d finds upright planes only"):
        Ransac.Params(model="2d", constraint="horizontal")


@pytest.mark.parametrize("noise_m", [0.001, 0.005])
def test_the_tolerance_found_by_itself_follows_the_noise(noise_m: float, tmp_path: Path) -> None:
    cloud = cloud_of(sampled(noise_m=noise_m), stations=STATION)
    out, ctx = detect(cloud, tmp_path, scoring="a-contrario")
    own_m = {m.name: m.value for m in ctx.metrics}["own_tolerance_mm"] / 1000.0
    # Of a normal distribution 2 sigma hold 95 %: where each further millimetre adds too little.
    assert 1.3 * noise_m < own_m < 3.5 * noise_m
    assert out.planes.details["raw"][0]["own_tolerance_m"] == pytest.approx(own_m)


def test_other_scores_have_no_tolerance_of_their_own(tmp_path: Path) -> None:
    out, ctx = detect(cloud_of(sampled()), tmp_path)
    assert "own_tolerance_mm" not in {metric.name for metric in ctx.metrics}
    assert out.planes.details["raw"][0]["own_tolerance_m"] is None


def test_chance_alone_is_not_meaningful_a_contrario_and_a_wall_is() -> None:
    rng = np.random.default_rng(0)
    background_m = rng.uniform(-2.0, 2.0, 5_000)
    wall_m = rng.normal(0.0, 0.002, 500)
    extents_m = np.array([4.0])
    alone = fewest_false_alarms(histogram_of(background_m, 0.05), 0.05, 5_000, extents_m, 3)
    both = np.concatenate([background_m, wall_m])
    found = fewest_false_alarms(histogram_of(both, 0.05), 0.05, 5_500, extents_m, 3)
    assert alone.value[0] < 0.0
    assert found.value[0] > 100.0
    assert 0.003 < found.tolerance_m[0] < 0.007


def test_hypotheses_pass_through_points_near_each_other() -> None:
    rng = np.random.default_rng(0)
    points_m = sampled()[::10]
    ordered = points_m[curve_order(points_m)]
    shares = []
    for points in (ordered, rng.permutation(points_m)):
        drawn = draw_hypotheses(points, 2_000, "3d", UP, rng)
        np.testing.assert_allclose(np.linalg.norm(drawn.normals, axis=1), 1.0, atol=1e-12)
        distances_m = np.abs(points @ drawn.normals.T - drawn.offsets_m)
        assert ((distances_m < 1e-9).sum(axis=0) >= 3).all()
        # A hypothesis on the small table holds little more than the table's 3 % of the points.
        table_m = np.abs(drawn.offsets_m * drawn.normals[:, 2] + 0.75)
        shares.append(np.mean((np.abs(drawn.normals[:, 2]) > 0.999) & (table_m < 0.01)))
    assert shares[0] > 0.001
    assert shares[1] < 0.0001
