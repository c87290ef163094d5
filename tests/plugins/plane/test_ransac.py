"""`plane.ransac`: scores, models, its own tolerance; and the comparators of open3d."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.plane.comparators import Open3dPatches, Open3dRansac, load_open3d
from orthoflow_plugins.plane.ransac import (
    Ransac,
    curve_order,
    draw_hypotheses,
    fewest_false_alarms,
)
from pydantic import ValidationError

from orthoflow.errors import PluginError
from orthoflow.geometry import angle_between_deg
from orthoflow.sdk import Method
from tests.long_loops import IS_LONG
from tests.plane_scenes import ROOM, STATION, cloud_of, detect, errors, sampled

UP = np.array([0.0, 0.0, 1.0])


def histogram_of(distances_m: NDArray[np.float64], reach_m: float) -> NDArray[np.int64]:
    counts = np.histogram(np.abs(distances_m), bins=100, range=(0.0, reach_m))[0]
    return counts[None].astype(np.int64)


@pytest.mark.parametrize("seed", range(50 if IS_LONG else 2))
def test_no_seed_misses_a_wall(seed: int, tmp_path: Path) -> None:
    cloud = cloud_of(sampled(seed=seed), stations=STATION)
    out, ctx = detect(Ransac, cloud, tmp_path, seed=seed)
    for truth in ROOM[:6]:
        angle_deg, miss_m = errors(out.planes, truth)
        assert angle_deg < 0.02
        assert miss_m < 2e-4
    # Scores but a-contrario have no tolerance of their own.
    assert "own_tolerance_mm" not in {metric.name for metric in ctx.metrics}
    assert out.planes.details["raw"][0]["own_tolerance_m"] is None


def test_the_plan_model_finds_the_walls_and_lets_them_lean(tmp_path: Path) -> None:
    cloud = cloud_of(sampled(), stations=STATION)
    planes = detect(Ransac, cloud, tmp_path, model="2d")[0].planes
    assert len(planes) == 4
    assert abs(planes.normal[0] @ UP) == pytest.approx(np.sin(np.radians(0.4)), abs=2e-4)
    raw = np.array([item["normal"] for item in planes.details["raw"]])
    np.testing.assert_allclose(raw @ UP, 0.0, atol=1e-9)
    with pytest.raises(ValidationError, match="model: 2d finds only vertical planes"):
        Ransac.Params(model="2d", constraint="horizontal")


@pytest.mark.parametrize("noise_m", [0.001, 0.005])
def test_the_tolerance_found_by_itself_follows_the_noise(noise_m: float, tmp_path: Path) -> None:
    cloud = cloud_of(sampled(noise_m=noise_m), stations=STATION)
    out, ctx = detect(Ransac, cloud, tmp_path, scoring="a-contrario")
    own_m = {m.name: m.value for m in ctx.metrics}["own_tolerance_mm"] / 1000.0
    # Of a normal distribution 2 sigma hold 95 %: where each further millimetre adds too little.
    assert 1.3 * noise_m < own_m < 3.5 * noise_m
    assert out.planes.details["raw"][0]["own_tolerance_m"] == pytest.approx(own_m)


def test_chance_alone_is_not_meaningful_a_contrario_and_a_wall_is() -> None:
    rng = np.random.default_rng(0)
    background_m = rng.uniform(-2.0, 2.0, 5_000)
    both = np.concatenate([background_m, rng.normal(0.0, 0.002, 500)])
    alone, found = (
        fewest_false_alarms(histogram_of(values, 0.05), 0.05, len(values), np.array([4.0]), 3)
        for values in (background_m, both)
    )
    assert alone.value[0] < 0.0
    assert found.value[0] > 100.0
    assert 0.003 < found.tolerance_m[0] < 0.007


def test_hypotheses_pass_through_points_near_each_other() -> None:
    rng = np.random.default_rng(0)
    points_m = sampled()[::10]
    shares = []
    for points in (points_m[curve_order(points_m)], rng.permutation(points_m)):
        drawn = draw_hypotheses(points, 2_000, "3d", UP, rng)
        np.testing.assert_allclose(np.linalg.norm(drawn.normals, axis=1), 1.0, atol=1e-12)
        distances_m = np.abs(points @ drawn.normals.T - drawn.offsets_m)
        assert ((distances_m < 1e-9).sum(axis=0) >= 3).all()
        # A hypothesis on the small table holds little more than the table's 3 % of the points.
        table_m = np.abs(drawn.offsets_m * drawn.normals[:, 2] + 0.75)
        shares.append(np.mean((np.abs(drawn.normals[:, 2]) > 0.999) & (table_m < 0.01)))
    assert shares[0] > 0.001
    assert shares[1] < 0.0001


@pytest.mark.parametrize("thinning", [1, 3])
def test_without_refit_planes_stay_as_the_detector_gave_them(tmp_path: Path, thinning: int) -> None:
    cloud = cloud_of(sampled()[::2], stations=STATION)
    planes, fitted = (
        detect(Ransac, cloud, tmp_path, refit=refit, thinning=thinning)[0].planes
        for refit in (False, True)
    )
    assert len(planes) == len(fitted)
    for k, raw in enumerate(planes.details["raw"]):
        np.testing.assert_allclose(planes.normal[k], raw["normal"], atol=1e-12)
        assert planes.offset[k] == pytest.approx(raw["offset_m"], abs=1e-12)
    front = ROOM[0].normal
    apart = [
        min(angle_between_deg(each.normal[0], sign * front) for sign in (1.0, -1.0))
        for each in (planes, fitted)
    ]
    assert apart[1] < 0.02 < apart[0] < 1.0


# --- open3d ---


@pytest.mark.usefixtures("_open3d")
@pytest.mark.parametrize("method", [Open3dRansac, Open3dPatches])
def test_comparators_find_the_large_planes_of_a_room(method: type[Method], tmp_path: Path) -> None:
    cloud = cloud_of(sampled()[::2], stations=STATION)
    out, _ = detect(method, cloud, tmp_path / "all")
    # open3d's own word: chance decides about small planes, patches need denser ones.
    for truth in (ROOM[0], ROOM[4], ROOM[5]):
        angle_deg, miss_m = errors(out.planes, truth)
        assert angle_deg < 0.03
        assert miss_m < 3e-4
    own = out.labels.plane_index[: ROOM[0].n_points // 2]
    assert np.mean(own == np.bincount(own[own >= 0]).argmax()) > 0.97
    # A constraint passes over what open3d finds first.
    planes = detect(method, cloud, tmp_path, constraint="horizontal")[0].planes
    assert len(planes) >= 2
    assert (np.abs(planes.normal @ planes.up) > 0.99).all()


def test_an_open3d_that_is_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(PluginError, match=r"plane\.x needs open3d, which is not installed: .* pip"):
        load_open3d("plane.x")
