"""`register.similarity` finds the transformation that was applied, and says how well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.register.similarity import RegisterSimilarity, Similarity

from orthoflow.errors import MethodError
from orthoflow.products import CheckPoints
from tests import raster_scenes as scenes
from tests.inspect_scenes import points_at

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
    inputs = RegisterSimilarity.In(cloud=cloud, points=points, control=control)
    out = RegisterSimilarity().run(inputs, RegisterSimilarity.Params.model_validate(params), ctx)
    return out, {metric.name: metric.value for metric in ctx.metrics}


def places(seed: int, count: int = 8) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(-5.0, 5.0, (count, 3))


@pytest.mark.parametrize("seed", range(3))
def test_the_transformation_is_found_and_moves_the_cloud(tmp_path: Path, seed: int) -> None:
    true, source = turned(seed), places(seed)
    out, metrics = register(tmp_path, points_at(source), points_at(true.apply(source)))
    cloud = scenes.cloud_of(np.random.default_rng(1).uniform(-4.0, 4.0, (500, 3)))
    np.testing.assert_allclose(
        out.cloud.points_world(), true.apply(cloud.points_world()), atol=5e-6
    )
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


def test_six_parameters_leave_the_scale_alone(tmp_path: Path) -> None:
    true = replace(turned(2), scale=1.0)
    source = places(2)
    out, metrics = register(
        tmp_path, points_at(source), points_at(true.apply(source)), with_scale=False
    )
    assert metrics["scale_ppm"] == 0.0
    assert metrics["sigma0_mm"] < 1e-5
    assert len(out.cloud) == 500


def test_too_few_pairs_and_lines_are_refused(tmp_path: Path) -> None:
    source = places(3, 5)
    other = replace(points_at(source), names=("A", "B", "P2", "P3", "C"))
    with pytest.raises(MethodError, match=r"2 names are in both lists of points \(P2, P3\)"):
        register(tmp_path, points_at(source), other)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(MethodError, match="lie on one line"):
        register(tmp_path, points_at(line), points_at(line))
