"""Known displacements are measured by patches and by pairs of SURF key points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.inspect import key_pairs, patches, surf
from orthoflow_plugins.inspect.image_quality import OrthoimageGrey
from orthoflow_plugins.inspect.key_pairs import find_key_pairs
from orthoflow_plugins.inspect.patches import GreyImage, PatchShifts
from orthoflow_plugins.inspect.surf import InspectSurf
from scipy.ndimage import shift

from orthoflow.errors import MethodError
from orthoflow.products import Inspection, Orthoimage, Orthoimages, Walls
from orthoflow.sdk import StepContext
from tests import inspect_scenes
from tests.inspect_scenes import GSD_M, displaced


def inspect(
    folder: Path, image: Orthoimage, walls: Walls | None = None, **params: object
) -> tuple[dict[str, float], Inspection, StepContext]:
    inputs: Any = {"orthoimages": Orthoimages(images=(image,))}
    inputs["walls"] = walls or inspect_scenes.walls()
    return inspect_scenes.inspected(InspectSurf, folder, params, **inputs)


@pytest.mark.parametrize("shift", [(1.4, -0.6), (20.0, 15.0)], ids=["small", "gross"])
def test_displacements_are_known_to_0_1_cells(tmp_path: Path, shift: tuple[float, float]) -> None:
    metrics, found, context = inspect(tmp_path, displaced(*shift))
    assert metrics["n_pairs"] >= 50
    for axis, cells in zip("xy", shift, strict=True):
        exact = pytest.approx(1e3 * GSD_M * cells, abs=0.1e3 * GSD_M)
        assert metrics[f"mean_{axis}_mm"] == exact
        assert metrics[f"rmse_{axis}_mm"] * np.sign(cells) == exact
        assert metrics[f"floor_rmse_{axis}_mm"] < 0.15e3 * GSD_M
        # SURF alone is several times less accurate than the refined pairs.
        assert metrics[f"surf_floor_rmse_{axis}_mm"] > metrics[f"floor_rmse_{axis}_mm"]
    assert len(found.displacement_m) == metrics["n_pairs"]
    assert [figure.name for figure in context.figures] == ["wall_0_displacements"]


@pytest.mark.parametrize(
    ("source", "sentence"),
    [("luminance", "no laser intensity"), ("none", "neither intensity nor colour")],
)
def test_walls_need_laser_intensity(tmp_path: Path, source: str, sentence: str) -> None:
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
    assert max(metrics["rmse_x_mm"], metrics["rmse_y_mm"]) < 0.2e3 * GSD_M
    elsewhere = replace(coarse, origin_world=coarse.origin_world + 0.5 * coarse.normal_world)
    with pytest.raises(MethodError, match=r"is 0\.500 m in front of wall 0"):
        inspect(tmp_path, inspect_scenes.image_of(means, elsewhere))


def some_pairs(count: int, shift_cells: float = 1.0) -> PatchShifts:
    places = np.column_stack([np.arange(count, dtype=np.float64), np.full(count, 9.0)])
    shift = np.full((count, 2), shift_cells)
    return replace(patches.unrefined(places, shift), found=2.0 * shift)


@pytest.mark.parametrize(("n_pairs", "is_inspected"), [(9, False), (10, True)])
def test_ten_pairs_say_something(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_pairs: int, is_inspected: bool
) -> None:
    monkeypatch.setattr(surf, "find_key_pairs", lambda *_, **__: some_pairs(n_pairs))
    metrics, found, context = inspect(tmp_path, displaced(0.0, 0.0), unfit="warn")
    assert metrics["n_walls_inspected"] == is_inspected
    assert len(context.warnings) == (not is_inspected)
    assert all(f"the largest number found is {n_pairs}" in text for text in context.warnings)
    if is_inspected:
        assert metrics["surf_rmse_x_mm"] == pytest.approx(2.0 * metrics["rmse_x_mm"])
        # The shift of the copy is subtracted.
        assert metrics["floor_rmse_x_mm"] == pytest.approx(0.5e3 * GSD_M)
        assert metrics["floor_rmse_y_mm"] == pytest.approx(0.75e3 * GSD_M)
        assert metrics["surf_floor_rmse_y_mm"] == pytest.approx(1.75e3 * GSD_M)
        assert len(found.displacement_m) == 10


def key_points(count: int) -> key_pairs.SurfPoints:
    ones = np.ones(count)
    return key_pairs.SurfPoints(
        places=np.full((count, 2), 10.0), scale=ones, sign=ones, descriptors=np.eye(8)[:count]
    )


def test_without_candidates_there_are_no_pairs() -> None:
    some, none = key_points(1), key_points(0)
    for first, second in ((none, some), (some, none), (some, replace(some, sign=-some.sign))):
        assert key_pairs.matched_pairs(first, second, 5.0).shape == (0, 2)


def test_of_few_pairs_two_others_must_agree() -> None:
    places, shift = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]]), np.zeros((3, 2))
    assert key_pairs.agreeing_pairs(places, shift).all()
    assert not key_pairs.agreeing_pairs(places[:2], shift[:2]).any()
    shift[2] = 5.0
    assert not key_pairs.agreeing_pairs(places, shift).any()


def test_tiles_give_the_pairs_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, true = (OrthoimageGrey(displaced(*by)) for by in ((1.4, -0.6), (0.0, 0.0)))
    whole = find_key_pairs(shown, true, radius_cells=40.0)
    monkeypatch.setattr(key_pairs, "WHOLE_CELLS", 1000)
    monkeypatch.setattr(key_pairs, "TILE_CELLS", 150)
    # The margin contains the support of the widest descriptors, so all points are found as in the
    # whole image.
    monkeypatch.setattr(key_pairs, "RIM_CELLS", 400)
    tiled = find_key_pairs(shown, true, radius_cells=40.0)
    assert len(tiled) == len(whole) >= 50
    one, other = (
        np.column_stack([pairs.centre, pairs.found, pairs.shift])[
            np.lexsort((*pairs.centre.T, *pairs.found.T))
        ]
        for pairs in (tiled, whole)
    )
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def image(grey: NDArray[np.float64]) -> GreyImage:
    everywhere = np.ones(grey.shape, dtype=np.bool_)
    return GreyImage(grey=grey, valid=everywhere, region=everywhere)


def moved(grey: NDArray[np.float64], right: float, down: float) -> NDArray[np.float64]:
    return np.asarray(shift(grey, (down, right), order=3, mode="nearest"))


@pytest.mark.parametrize("apart", [(0.0, 0.0), (1.3, -2.6), (-3.0, 3.75), (5.0, -5.0), (-5.0, 5.0)])
def test_a_displacement_is_measured_in_every_whole_patch(apart: tuple[float, float]) -> None:
    true = inspect_scenes.texture()[:130, :130]
    found = patches.measure_shifts(image(moved(true, *apart)), image(true), reach_cells=5)
    # 130 cells contain 4 x 4 patches of 32 cells; two cells remain.
    centres = [[32 * c + 16.0, 32 * r + 16.0] for r in range(4) for c in range(4)]
    assert found.centre.tolist() == centres
    np.testing.assert_allclose(found.shift, np.tile(apart, (16, 1)), atol=0.03)
    assert (np.abs(found.found - apart) <= 0.51).all()
    assert (found.sigma < 0.15).all()
    assert (found.correlation > 0.98).all()


def test_what_strays_by_two_cells_from_its_start_is_left_out() -> None:
    true = inspect_scenes.texture()[:130, :130]
    start = patches.unrefined(
        np.array([[40.0, 40.0], [80.0, 40.0]]), np.array([[1.0, 0.0], [6.0, 0.0]])
    )
    found = patches.refine_shifts(
        image(moved(true, 1.8, 0.0)), image(true), start, sigma_most_cells=0.5
    )
    assert found.centre.tolist() == [[40.0, 40.0]]
    np.testing.assert_allclose(found.shift, [[1.8, 0.0]], atol=0.03)
    np.testing.assert_array_equal(found.found, [[1.0, 0.0]])
    noisy = image(true + np.random.default_rng(6).normal(size=true.shape))
    none = patches.refine_shifts(noisy, image(true), start, sigma_most_cells=1e-4)
    assert len(none.centre) == 0
    empty = patches.unrefined(np.zeros((0, 2)), np.zeros((0, 2)))
    assert patches.refine_shifts(image(true), image(true), empty, sigma_most_cells=1.0) is empty
