"""Passers-by drawn onto photos of a known wall, with and without a scan."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic.consensus import consensus
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.geometry.bands import in_memory
from orthoflow.products import Layer, LayerMask, Layers, OrthoMask, Wall, is_shown
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context, numbers

SHAPE, GSD_M = (240, 400), 0.01
FRAME = samples.facing_south(GSD_M, SHAPE[1], SHAPE[0])
# A person of 0.5 x 1.7 m.
PERSON = (slice(60, 230), slice(180, 230))
IS_PERSON = np.zeros(SHAPE, np.bool_)
IS_PERSON[PERSON] = True


def painted_wall(seed: int = 3) -> NDArray[np.float64]:
    """Return levels (rows, cols, 3) of a wall with stains and joints."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(90.0, 200.0, (12, 20, 3))
    wall = cv2.resize(coarse, (SHAPE[1], SHAPE[0]), interpolation=cv2.INTER_CUBIC)
    wall[::40] *= 0.6
    wall[:, ::50] *= 0.6
    return np.asarray(wall)


def photo(
    name: str, levels: NDArray[np.float64], *, seed: int, columns: slice | None = None
) -> Layer:
    """Return a noisy photo of all or some columns of the wall, displaced by a third of a cell."""
    rng = np.random.default_rng(seed)
    moved = levels + (1 / 3) * (np.roll(levels, 1, axis=1) - levels)
    rgb = np.clip(moved + rng.normal(0.0, 2.0, levels.shape), 0, 255).astype(np.uint8)
    mask = np.full(SHAPE, LayerMask.PAINTED, np.uint8)
    if columns is not None:
        mask[:] = LayerMask.OUTSIDE
        mask[:, columns] = LayerMask.PAINTED
    return samples.layer(mask, frame=FRAME, source=name, rgb=rgb)


def with_person(levels: NDArray[np.float64]) -> NDArray[np.float64]:
    passed = levels.copy()
    passed[PERSON] = [35.0, 50.0, 110.0]
    return passed


def scanned(levels: NDArray[np.float64] | None, *, intensity: bool = False) -> Wall | None:
    """Return the wall as scanned: darker, with colours or laser intensity."""
    if levels is None:
        return None
    wall = samples.wall(FRAME, depth_m=np.zeros(SHAPE, np.float32))
    noisy = 0.7 * levels + np.random.default_rng(9).normal(0.0, 6.0, levels.shape)
    if intensity:
        return replace(wall, intensity=(noisy.mean(axis=2) / 255.0).astype(np.float32))
    rgb = np.clip(noisy, 0, 255).astype(np.uint8)
    return replace(wall, rgb=rgb, rgb_mask=np.ones(SHAPE, np.uint8))


found = partial(consensus, allocate=in_memory)


def outvoted(before: Layer, after: Layer) -> NDArray[np.bool_]:
    return (before.mask == LayerMask.PAINTED) & (after.mask != LayerMask.PAINTED)


@pytest.mark.parametrize("witness", ["third photo", "colours", "laser"])
@pytest.mark.parametrize("place", [0, 1])
def test_a_passer_by_yields_to_what_others_show(witness: str, place: int) -> None:
    levels = painted_wall()
    photos = [photo(f"{k}.jpg", levels, seed=k) for k in range(3 if "photo" in witness else 2)]
    photos[place] = photo("passed.jpg", with_person(levels), seed=7)
    wall = scanned(levels if "photo" not in witness else None, intensity=witness == "laser")
    kept, n_outvoted, _ = found(photos, wall)
    for k, (before, after) in enumerate(zip(photos, kept, strict=True)):
        lost = outvoted(before, after)
        if k != place:
            assert not lost.any()
            continue
        # At most one cell in a thousand still shows the person, and few other cells are lost.
        assert np.count_nonzero(IS_PERSON & ~lost) <= 1e-3 * IS_PERSON.size
        assert np.count_nonzero(lost & ~IS_PERSON) < 0.5 * np.count_nonzero(IS_PERSON)
    assert n_outvoted == np.count_nonzero(outvoted(photos[place], kept[place]))


def test_two_photos_alone_cannot_say_who_is_right() -> None:
    levels = painted_wall()
    photos = [photo("a.jpg", levels, seed=1), photo("b.jpg", with_person(levels), seed=2)]
    kept, n_outvoted, _ = found(photos, None)
    assert n_outvoted == 0
    assert all(one is other for one, other in zip(photos, kept, strict=True))


def test_what_one_photo_alone_shows_stays_in_a_class_of_its_own(tmp_path: Path) -> None:
    levels = painted_wall()
    photos = [
        photo("a.jpg", with_person(levels), seed=1),
        photo("b.jpg", levels, seed=2, columns=slice(0, 150)),
    ]
    _, n_outvoted, contradicted = found(photos, scanned(levels))
    assert n_outvoted == 0
    assert contradicted is not None
    # Regions consist of whole blocks, so the border of the person may be missing.
    assert contradicted[IS_PERSON].mean() > 0.85
    assert np.count_nonzero(contradicted & ~IS_PERSON) < 0.5 * np.count_nonzero(IS_PERSON)
    # Contradicted cells have a separate value in the mask of the orthoimage, and their share is
    # reported.
    inputs = {"layers": Layers(layers=tuple(photos)), "walls": samples.walls(scanned(levels))}
    ctx = context(tmp_path)
    (image,) = run(MosaicSeams, ctx, inputs).orthoimages.images
    is_alone = image.mask == OrthoMask.CONTRADICTED
    np.testing.assert_array_equal(is_alone, contradicted)
    assert (image.source[is_alone] == 0).all()
    assert is_shown(image.mask).all()
    assert numbers(ctx)["contradicted_share"] == pytest.approx(is_alone.mean())
    assert "photo-against-scan" in [one.code for one in ctx.diagnostics]
    clean = [photo("a.jpg", levels, seed=1), photos[1]]
    *_, nothing = found(clean, scanned(levels))
    assert nothing is not None
    assert not nothing.any()


def test_light_that_changes_smoothly_is_no_contradiction() -> None:
    levels = painted_wall()
    across = np.linspace(0.75, 1.25, SHAPE[1])[None, :, None]
    photos = [
        photo("a.jpg", levels * across, seed=1),
        photo("b.jpg", levels * across[:, ::-1], seed=2),
        photo("c.jpg", 0.8 * levels, seed=3),
    ]
    _, n_outvoted, contradicted = found(photos, scanned(levels))
    assert (n_outvoted, contradicted is None or contradicted.any()) == (0, False)


def test_a_scan_that_sees_other_patterns_bears_no_witness() -> None:
    levels = painted_wall()
    photos = [photo("a.jpg", levels, seed=1), photo("b.jpg", with_person(levels), seed=2)]
    other = scanned(painted_wall(seed=99)[::-1, ::-1], intensity=True)
    assert found(photos, other)[1] == 0
