"""`register.similarity` finds a known transformation and its accuracy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.register.similarity import RegisterSimilarity, Similarity, fit_similarity

from orthoflow.errors import MethodError
from orthoflow.products import CheckPoints
from tests import raster_scenes as scenes
from tests.inspect_scenes import points_at
from tests.long_loops import seeds
from tests.method_runs import run

STATIONS = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 2.0]])
SURVEY = np.array([634512.347, 486215.781, 112.193])


def turned(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    return Similarity(scale=float(rng.uniform(0.3, 3.0)), rotation=rotation, translation=SURVEY)


def register(
    folder: Path, points: CheckPoints, control: CheckPoints, **params: object
) -> tuple[RegisterSimilarity.Out, dict[str, float]]:
    ctx = scenes.context(folder)
    cloud = scenes.cloud_of(np.random.default_rng(1).uniform(-4.0, 4.0, (500, 3)))
    # As with a cloud from photos, z points down.
    cloud = replace(cloud, up=np.array([0.0, 0.0, -1.0]), stations=STATIONS, stations_source="file")
    inputs = {"cloud": cloud, "points": points, "control": control}
    return run(RegisterSimilarity, ctx, inputs, **params), scenes.numbers(ctx)


def places(seed: int, count: int = 8) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(-5.0, 5.0, (count, 3))


@pytest.mark.parametrize("with_scale", [True, False])
@pytest.mark.parametrize("seed", seeds(3))
def test_the_transformation_is_found_and_moves_the_cloud(
    tmp_path: Path, seed: int, with_scale: bool
) -> None:
    true, source = turned(seed), places(seed)
    true = true if with_scale else replace(true, scale=1.0)
    control = points_at(true.apply(source))
    out, metrics = register(tmp_path, points_at(source), control, with_scale=with_scale)
    cloud = scenes.cloud_of(np.random.default_rng(1).uniform(-4.0, 4.0, (500, 3)))
    np.testing.assert_allclose(
        out.cloud.points_world(), true.apply(cloud.points_world()), atol=5e-6
    )
    assert out.cloud.stations is not None
    np.testing.assert_allclose(out.cloud.stations, true.apply(STATIONS), atol=1e-6)
    assert metrics["sigma0_mm"] < 1e-5
    assert metrics["scale_ppm"] == pytest.approx(1e6 * (true.scale - 1.0), abs=1e-2)
    assert metrics["n_pairs"] == 8


def test_sigma0_is_the_noise_of_a_coordinate_and_left_out_points_tell_more(tmp_path: Path) -> None:
    true, source = turned(5), places(5, 200)
    noise = 0.004 * np.random.default_rng(6).normal(size=source.shape)
    out, metrics = register(tmp_path, points_at(source), points_at(true.apply(source) + noise))
    # The standard deviation of sigma0 with 593 degrees of freedom is 2.9 %.
    assert metrics["sigma0_mm"] == pytest.approx(4.0, rel=0.12)
    assert metrics["left_out_rms_mm"] > metrics["rms_mm"]
    assert out.inspection.details["residuals"]


def test_too_few_pairs_and_lines_are_refused(tmp_path: Path) -> None:
    source = places(3, 5)
    other = replace(points_at(source), names=("A", "B", "P2", "P3", "C"))
    with pytest.raises(MethodError, match=r"at least 3 names .* only these are: P2, P3"):
        register(tmp_path, points_at(source), other)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(MethodError, match="are on one line"):
        register(tmp_path, points_at(line), points_at(line))


def test_residuals_and_what_they_add_up_to_are_told(tmp_path: Path) -> None:
    source, off = places(4, 6), 0.001 * np.random.default_rng(9).normal(size=(6, 3))
    true = turned(4)
    control = replace(points_at(true.apply(source) + off), names=tuple("FEDCBA"))
    # Pairs have the same names, in the order of the points.
    points = replace(points_at(source), names=control.names)
    backwards = {"names": control.names[::-1], "points_world": control.points_world[::-1]}
    out, metrics = register(tmp_path, points, replace(control, **backwards))
    inspection = out.inspection
    details: Any = inspection.details
    fitted = details["target_from_source"]
    rotation, shift = np.array(fitted["rotation"]), np.array(fitted["translation_m"])
    residual = fitted["scale"] * source @ rotation.T + shift - control.points_world
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(inspection.displacement_m, residual[:, :2], atol=1e-9)
    np.testing.assert_array_equal(inspection.points_world, control.points_world)
    for row, name, values in zip(details["residuals"], control.names, residual, strict=True):
        assert row["name"] == name
        found = [row["dx_mm"], row["dy_mm"], row["dz_mm"]]
        np.testing.assert_allclose(found, 1e3 * values, atol=6e-5)
    length = 1e3 * np.linalg.norm(residual, axis=1)
    # 18 coordinates minus seven parameters.
    assert metrics["sigma0_mm"] == pytest.approx(1e3 * np.sqrt((residual**2).sum() / 11.0))
    assert metrics["rms_mm"] == pytest.approx(np.sqrt((length**2).mean()))
    assert metrics["max_mm"] == pytest.approx(length.max())
    apart = []
    for k in range(6):
        others = np.arange(6) != k
        fit = fit_similarity(source[others], control.points_world[others], with_scale=True)
        apart.append(np.linalg.norm(fit.apply(source[[k]])[0] - control.points_world[k]))
    assert metrics["left_out_rms_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(np.square(apart))))


@pytest.mark.parametrize("with_scale", [True, False])
def test_lists_that_mirror_each_other_are_refused(tmp_path: Path, with_scale: bool) -> None:
    source = places(3)
    control = source[:, [1, 0, 2]] + SURVEY  # north, east
    with pytest.raises(MethodError, match=r"mirror image of the other: .* swap x and y"):
        register(tmp_path, points_at(source), points_at(control), with_scale=with_scale)


@pytest.mark.parametrize(("params", "up"), [({}, [0, 0, 1]), ({"up": "-y"}, [0, -1, 0])])
def test_up_is_that_of_the_control(tmp_path: Path, params: dict[str, str], up: list[int]) -> None:
    points, control = points_at(places(1)), points_at(turned(1).apply(places(1)))
    out, _ = register(tmp_path, points, control, **params)
    np.testing.assert_array_equal(out.cloud.up, up)
