"""`inspect.surf` tells the displacements that were put in, and refuses what says nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect import surf
from orthoflow_plugins.inspect.key_pairs import KeyPairs
from orthoflow_plugins.inspect.surf import InspectSurf

from orthoflow.errors import MethodError
from orthoflow.products import Inspection, Orthoimage, Orthoimages, Walls
from orthoflow.sdk import StepContext
from tests import inspect_scenes
from tests.inspect_scenes import GSD_M, displaced


def inspect(
    folder: Path, image: Orthoimage, walls: Walls | None = None, **params: object
) -> tuple[dict[str, float], Inspection, StepContext]:
    context = StepContext(rng=np.random.default_rng(0), cores=1, scratch=folder)
    inputs = InspectSurf.In(
        orthoimages=Orthoimages(images=(image,)), walls=walls or inspect_scenes.walls()
    )
    out = InspectSurf().run(inputs, InspectSurf.Params.model_validate(params), context)
    return {item.name: item.value for item in context.metrics}, out.inspection, context


@pytest.mark.parametrize("shift", [(1.4, -0.6), (20.0, 15.0)], ids=["small", "gross"])
def test_a_displacement_is_told_to_a_tenth_of_a_cell(
    tmp_path: Path, shift: tuple[float, float]
) -> None:
    metrics, found, context = inspect(tmp_path, displaced(*shift))
    assert metrics["n_pairs"] >= 50
    for axis, cells in zip("xy", shift, strict=True):
        assert metrics[f"mean_{axis}_mm"] == pytest.approx(1e3 * GSD_M * cells, abs=0.1e3 * GSD_M)
        assert metrics[f"rmse_{axis}_mm"] == pytest.approx(
            1e3 * GSD_M * abs(cells), abs=0.1e3 * GSD_M
        )
        assert metrics[f"floor_rmse_{axis}_mm"] < 0.15e3 * GSD_M
        # SURF alone is several times coarser than what is refined.
        assert metrics[f"surf_floor_rmse_{axis}_mm"] > metrics[f"floor_rmse_{axis}_mm"]
    assert len(found.displacement_m) == metrics["n_pairs"]
    assert [figure.name for figure in context.figures] == ["wall_0_displacements"]


def test_part_of_the_image_displaced_shows_beyond_twice_the_rmse(tmp_path: Path) -> None:
    right, wrong = displaced(0.0, 0.0), displaced(6.0, 0.0)
    rgb = right.rgb.copy()
    rgb[:, 290:] = wrong.rgb[:, 290:]
    metrics, found, _ = inspect(tmp_path, replace(right, rgb=rgb))
    places = (found.points_world[:, 0] - 1.0) / GSD_M
    in_wrong_part = places > 310
    assert in_wrong_part.sum() >= 5
    np.testing.assert_allclose(found.displacement_m[in_wrong_part, 0], 6 * GSD_M, atol=GSD_M)
    np.testing.assert_allclose(found.displacement_m[places < 270, 0], 0.0, atol=GSD_M)
    assert 0.02 < metrics["beyond_2rmse_x_share"] <= 0.25


@pytest.mark.parametrize(
    ("source", "sentence"),
    [("luminance", "no laser intensity"), ("none", "neither intensity nor colour")],
)
def test_walls_without_laser_intensity_are_refused_or_passed_over(
    tmp_path: Path, source: str, sentence: str
) -> None:
    image, walls = displaced(0.0, 0.0), inspect_scenes.walls(source=source)
    with pytest.raises(MethodError, match=sentence):
        inspect(tmp_path, image, walls)
    metrics, found, context = inspect(tmp_path, image, walls, unfit="warn")
    assert sentence in context.warnings[0]
    assert metrics == {"n_walls_inspected": 0.0}
    assert len(found.displacement_m) == 0


def test_an_image_of_something_else_has_too_little_in_common(tmp_path: Path) -> None:
    other = np.random.default_rng(5).uniform(30.0, 220.0, inspect_scenes.SHAPE)
    with pytest.raises(MethodError, match="are too different"):
        inspect(tmp_path, inspect_scenes.image_of(other))


def test_an_image_on_cells_of_its_own_is_compared_there(tmp_path: Path) -> None:
    coarse = inspect_scenes.frame(gsd_m=2 * GSD_M, shape=(140, 180))
    means = inspect_scenes.texture().reshape(140, 2, 180, 2).mean(axis=(1, 3))
    metrics, _, _ = inspect(tmp_path, inspect_scenes.image_of(means, coarse))
    assert metrics["rmse_x_mm"] < 0.2e3 * GSD_M
    assert metrics["rmse_y_mm"] < 0.2e3 * GSD_M
    elsewhere = replace(coarse, origin_world=coarse.origin_world + 0.5 * coarse.normal_world)
    with pytest.raises(MethodError, match=r"is 0\.500 m in front of wall 0"):
        inspect(tmp_path, inspect_scenes.image_of(means, elsewhere))


def some_pairs(count: int, shift_cells: float = 1.0) -> KeyPairs:
    places = np.column_stack([np.arange(count, dtype=np.float64), np.full(count, 9.0)])
    shift = np.full((count, 2), shift_cells)
    return KeyPairs(
        places=places, shift=shift, found=2.0 * shift, n_points=(40, 30), n_matched=count
    )


@pytest.mark.parametrize(("n_pairs", "is_inspected"), [(9, False), (10, True)])
def test_ten_pairs_say_something(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_pairs: int, is_inspected: bool
) -> None:
    monkeypatch.setattr(surf, "find_key_pairs", lambda *_, **__: some_pairs(n_pairs))
    metrics, found, context = inspect(tmp_path, displaced(0.0, 0.0), unfit="warn")
    assert metrics["n_walls_inspected"] == is_inspected
    assert [f"{n_pairs} pairs of SURF" in text for text in context.warnings] == (
        [] if is_inspected else [True]
    )
    if is_inspected:
        assert metrics["matched_kept_share"] == 1.0
        assert (metrics["n_key_points"], metrics["n_key_points_intensity"]) == (40, 30)
        assert metrics["surf_rmse_x_mm"] == pytest.approx(2.0 * metrics["rmse_x_mm"])
        # What the floor was laid aside by is taken off.
        assert metrics["floor_rmse_x_mm"] == pytest.approx(0.5e3 * GSD_M)
        assert metrics["floor_rmse_y_mm"] == pytest.approx(0.75e3 * GSD_M)
        assert metrics["surf_floor_rmse_y_mm"] == pytest.approx(1.75e3 * GSD_M)
        assert len(found.displacement_m) == 10
