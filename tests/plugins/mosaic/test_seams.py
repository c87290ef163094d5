"""`mosaic.seams`: one layer is unchanged; of several, each rule chooses one per cell."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import joining
from orthoflow_plugins.mosaic.agreement import count_seams
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.errors import InputError, MethodError
from orthoflow.files.drawing import plane_ink
from orthoflow.files.drawings.geojson import write_seams_geojson
from orthoflow.files.geotiff import read_raster
from orthoflow.files.images import decode_image
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.products import (
    InputFiles,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Walls,
)
from orthoflow.sdk import StepContext
from tests import inspect_scenes, samples
from tests.method_runs import run
from tests.plugins.mosaic import test_joining
from tests.raster_scenes import context, numbers
from tests.turns import OTHER_TURNS, TURNS, Turn


# The type is Any, since inputs and parameters have different types.
def joined(
    folder: Path,
    *layers: Layer,
    names: tuple[str, ...] = ("west",),
    inputs: Mapping[str, Any] | None = None,
    **params: Any,
) -> tuple[Orthoimages, StepContext]:
    """Return orthoimages of layers, by default without balancing and removal of islands."""
    ctx = context(folder)
    given = {"layers": Layers(layers=layers, names=names), **(inputs or {})}
    chosen = {"island_cells_min": 1, "gains": "none", **params}
    return run(MosaicSeams, ctx, given, **chosen).orthoimages, ctx


def image_of(folder: Path, *layers: Layer, **given: Any) -> Orthoimage:
    (image,) = joined(folder, *layers, **given)[0].images
    return image


def random_layer(seed: int, *, wall: int = 0) -> Layer:
    made = test_joining.layer(seed, source=f"photo {seed}")
    rgb = np.random.default_rng(seed).integers(0, 256, (*made.mask.shape, 3), dtype=np.uint8)
    rgb[made.mask != LayerMask.PAINTED] = 0
    return replace(made, wall=wall, rgb=rgb)


def test_every_wall_of_the_layers_gets_an_orthoimage(tmp_path: Path) -> None:
    layers = (random_layer(1, wall=0), random_layer(2, wall=2), random_layer(3, wall=0))
    images = joined(tmp_path, *layers, names=("a", "b", "c"))[0].images
    found = [(image.wall, image.name, len(image.sources)) for image in images]
    assert found == [(0, "a", 2), (2, "c", 1)]
    with pytest.raises(MethodError, match="there are no layers"):
        joined(tmp_path)


def test_shares_of_all_states_are_reported(tmp_path: Path) -> None:
    images, ctx = joined(tmp_path, random_layer(1), random_layer(2))
    (image,) = images.images
    metrics = numbers(ctx)
    n_seam, _ = count_seams(image.source, None)
    assert n_seam > 0
    # Differences of random colours have a standard deviation of 70 grey levels.
    assert 20.0 < metrics.pop("seam_step_rms_grey") < 150.0
    assert metrics.pop("seam_step_mean_delta_e") > 10.0
    assert metrics == pytest.approx(
        {
            **{f"{one.name.lower()}_share": np.mean(image.mask == one) for one in OrthoMask},
            "seam_share": n_seam / np.count_nonzero(image.source >= 0),
            "n_orthoimages": 1,
            "n_sources": 2,
            "n_overlap_patches": 0,
            # Random colours do not contradict each other over a region.
            "outvoted_share": 0.0,
            "contradicted_share": 0.0,
        }
    )


def layer(
    name: str, mask: NDArray[np.uint8], quality: NDArray[np.floating] | float = 1.0, *, rgb: int = 7
) -> Layer:
    """Return a layer with a single grey value."""
    is_painted = mask == LayerMask.PAINTED
    return samples.layer(
        mask,
        source=name,
        rgb=np.where(is_painted[..., None], np.uint8(rgb), np.uint8(0)) * np.ones(3, np.uint8),
        quality=np.where(is_painted, quality, 0.0).astype(np.float32),
    )


def two_halves() -> tuple[Layer, Layer]:
    """Return two noisy layers; the first is better on the left half, the second on the right."""
    shape = (30, 40)
    columns = np.indices(shape)[1]
    noise = np.random.default_rng(3).normal(0.0, 4.0, shape)
    whole = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    return (
        layer("left", whole, 50.0 - columns, rgb=10),
        layer("right", whole, 11.0 + columns + noise, rgb=20),
    )


def test_a_filling_is_not_enlarged_over_painted_cells(tmp_path: Path) -> None:
    left, right = two_halves()
    filled = np.ones_like(left.mask)
    filled[10:14, 5:9] = 0
    few = np.full_like(right.mask, LayerMask.OUTSIDE)
    few[20:24, 5:9] = LayerMask.PAINTED
    layers = replace(left, filled=filled), layer("right", few, right.quality, rgb=20)
    image = image_of(tmp_path, *layers, island_cells_min=100)
    expected = np.full_like(image.mask, OrthoMask.FILLED)
    expected[10:14, 5:9] = expected[20:24, 5:9] = OrthoMask.PAINTED
    np.testing.assert_array_equal(image.mask, expected)
    assert (image.source[20:24, 5:9] == 1).all()


def test_a_wall_that_nothing_paints_is_empty_and_that_is_said(tmp_path: Path) -> None:
    mask = np.full((30, 40), LayerMask.OCCLUDED, dtype=np.uint8)
    mask[:5], mask[5:9] = LayerMask.OUTSIDE, LayerMask.NO_SURFACE
    images, ctx = joined(tmp_path, layer("no photo", mask))
    (image,) = images.images
    assert [one.code for one in ctx.diagnostics] == ["orthoimage-empty"]
    assert (image.sources, image.source.max()) == ((), -1)
    assert (image.mask[:5] == OrthoMask.NONE).all()
    assert (image.mask[5:9] == OrthoMask.NO_SURFACE).all()
    assert (image.mask[9:] == OrthoMask.OCCLUDED).all()
    # Next to a painted layer, it is not a source, but shows which cells are hidden.
    mask[:, :20] = LayerMask.PAINTED
    blind = layer("blind", np.full_like(mask, LayerMask.OCCLUDED))
    image = image_of(tmp_path, blind, layer("left", mask))
    assert image.sources == ("left",)
    assert (image.source[:, :20] == 0).all()
    assert (image.mask[:5, 20:] == OrthoMask.OCCLUDED).all()


@pytest.mark.parametrize(
    ("missing", "n_rows", "no_surface", "causes"),
    [
        # Causes of at least 1 % of the cells are listed.
        (LayerMask.OUTSIDE, 10, 15, ["25% are in no oriented photo"]),
        (LayerMask.OCCLUDED, 10, 17, ["25% are hidden in all photos", "1% have no surface"]),
        # At least 10 % of the cells must be missing, without those that have no surface.
        (LayerMask.OUTSIDE, 3, 800, []),
    ],
    ids=["no photo", "hidden", "no surface"],
)
def test_empty_cells_are_reported_with_their_causes(
    tmp_path: Path, missing: LayerMask, n_rows: int, no_surface: int, causes: list[str]
) -> None:
    mask = np.full((40, 40), LayerMask.PAINTED, dtype=np.uint8)
    mask[:n_rows], mask.ravel()[mask.size - no_surface :] = missing, LayerMask.NO_SURFACE
    _, ctx = joined(tmp_path, layer("one", mask))
    found = [one.values for one in ctx.diagnostics if one.code == "orthoimage-cells-empty"]
    assert len(found) == bool(causes)
    for values in found:
        assert values["share"] == 0.25 + no_surface / 1600
        stated = values["causes"].split("; ")
        assert [one[: len(two)] for one, two in zip(stated, causes, strict=True)] == causes


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-3, 4)], ids=str)
def test_displacements_between_photos_are_measured(tmp_path: Path, shift: tuple[int, int]) -> None:
    noise = np.random.default_rng(2).integers(0, 256, (400, 400), np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    u, v = shift
    pictures = [texture[50:350, 50:350], texture[50 - v : 350 - v, 50 - u : 350 - u]]
    layers = [
        samples.layer((300, 300), source=f"{k}", rgb=np.dstack([picture] * 3))
        for k, picture in enumerate(pictures)
    ]
    metrics = numbers(joined(tmp_path, *layers, gains="global")[1])
    assert metrics["n_overlap_patches"] == 16
    cell_mm = 1e3 * layers[0].frame.gsd_m
    for axis, off in zip("uv", shift, strict=True):
        in_cells = metrics[f"overlap_{axis}_rms_cells"]
        assert in_cells == pytest.approx(abs(off), abs=0.15)
        assert metrics[f"overlap_{axis}_rms_mm"] == pytest.approx(cell_mm * in_cells)


@pytest.mark.usefixtures("charts")
def test_the_map_of_sources_has_a_colour_for_each(tmp_path: Path) -> None:
    (figure,) = joined(tmp_path, *two_halves())[1].figures
    picture = decode_image(figure.path.read_bytes()).astype(float)
    top = picture[20 : picture.shape[0] // 3]
    for middle, index in ((0.3, 0), (0.7, 1)):
        shown = top[:, round(middle * top.shape[1])].mean(axis=0)
        ink = np.array(plane_ink(index))
        # The tint is applied to grey, so the order of its channels is the same.
        np.testing.assert_array_equal(np.argsort(shown), np.argsort(ink, kind="stable"))


def test_layers_are_published_when_asked_for(tmp_path: Path) -> None:
    names = ("b/a b.jpg", "c/a b.jpg")
    layers = [replace(random_layer(k), source=name) for k, name in enumerate(names)]
    assert joined(tmp_path, *layers)[0].layers is None
    asked, _ = joined(tmp_path, *layers, publish_layers=True)
    publish_orthoimages(Orthoimages.from_payload(asked.to_payload()), tmp_path, "digest")
    for number, layer in enumerate(layers):
        stem = f"wall_0_layer_{number}_a-b"
        raster = read_raster(tmp_path / f"{stem}.tif")
        np.testing.assert_array_equal(raster.values, layer.rgb)
        np.testing.assert_array_equal(raster.shown, layer.mask == LayerMask.PAINTED)
        said = json.loads((tmp_path / f"{stem}.json").read_text())
        assert (said["source"], said["name"]) == (layer.source, "west")
        assert sum(said["mask_counts"].values()) == layer.mask.size


@pytest.mark.parametrize(("rgb", "tone"), [(2, "black"), (254, "white"), (128, "one value")])
def test_an_orthoimage_of_one_tone_is_reported(tmp_path: Path, rgb: int, tone: str) -> None:
    mask = np.full((60, 50), LayerMask.PAINTED, dtype=np.uint8)
    _, ctx = joined(tmp_path, layer("dark.jpg", mask, rgb=rgb))
    (found,) = [one for one in ctx.diagnostics if one.code == "orthoimage-of-one-tone"]
    assert (found.values["tone"], found.values["sources"]) == (tone, "dark.jpg")


# --- positions of seams by rule ---

WIDE = (40, 120)


def left_and_right(
    one: NDArray[np.uint8] | int, other: NDArray[np.uint8] | int
) -> tuple[Layer, Layer]:
    """Return layers of the columns up to 100 and from 20 on."""
    colours = [np.broadcast_to(np.asarray(rgb, np.uint8), (*WIDE, 3)) for rgb in (one, other)]
    return (
        inspect_scenes.painted_layer("left", slice(0, 100), colours[0], 1.0),
        inspect_scenes.painted_layer("right", slice(20, 120), colours[1], 1.0),
    )


def test_a_graph_cut_runs_where_the_photos_agree(tmp_path: Path) -> None:
    # The two pictures agree only in columns 64 to 67.
    rng = np.random.default_rng(4)
    one, other = (rng.integers(0, 256, (*WIDE, 3)).astype(np.uint8) for _ in range(2))
    other[:, 64:68] = one[:, 64:68]
    images, ctx = joined(tmp_path, *left_and_right(one, other), seams="graph-cut")
    source = images.images[0].source
    columns = np.argmax(source == 1, axis=1)
    assert ((columns >= 65) & (columns <= 67)).all()
    assert (source[:, :65] == 0).all()
    cut = numbers(ctx)
    assert cut["seam_step_rms_grey"] == cut["seam_step_mean_delta_e"] == 0.0
    _, ctx = joined(tmp_path, *left_and_right(one, other), seams="voronoi")
    assert numbers(ctx)["seam_step_rms_grey"] > 40.0


def test_a_graph_cut_keeps_off_depth_edges(tmp_path: Path) -> None:
    layers = left_and_right(10, 10)
    # The first photo is better up to its end, where the second edge is.
    for rule, edge, share in (
        ("graph-cut", slice(60, 63), 0.0),
        ("best-view", slice(100, 120), 1.0),
    ):
        depth = np.zeros(WIDE, dtype=np.float32)
        depth[:, edge] = 0.1
        walls = samples.walls(samples.wall(layers[0].frame, depth_m=depth))
        _, ctx = joined(tmp_path, *layers, inputs={"walls": walls}, seams=rule)
        assert numbers(ctx)["seam_on_depth_edge_share"] == share


# --- no preferred direction ---


def three_discs(shape: tuple[int, int], turn: Turn = TURNS[0]) -> tuple[tuple[Layer, ...], Walls]:
    """Return layers with one disc each, at different positions, and a wall with a round recess."""
    rng = np.random.default_rng(3)
    frame = inspect_scenes.frame(shape=turn.shape(shape))
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    layers = []
    for k, (at_row, at_column) in enumerate(rng.uniform(0.2, 0.8, (3, 2)) * shape):
        distance = np.hypot(rows - at_row, columns - at_column)
        is_painted = distance < 0.6 * max(shape)
        grey = cv2.GaussianBlur(rng.normal(0.0, 1.0, (*shape, 3)), (0, 0), 3.0)
        rgb = np.clip(128.0 + 300.0 * grey + 10.0 * k, 0, 255).astype(np.uint8)
        made = samples.layer(
            turn.raster(is_painted.astype(np.uint8)),
            frame=frame,
            source=f"photo {k}",
            rgb=turn.raster(np.where(is_painted[..., None], rgb, np.uint8(0))),
            quality=turn.raster(np.where(is_painted, 1.0 / (1.0 + distance), 0.0)).astype("f4"),
        )
        layers.append(made)
    is_near = np.hypot(rows - 0.5 * shape[0], columns - 0.4 * shape[1]) < 0.2 * min(shape)
    depth_m = turn.raster(np.where(is_near, np.float32(0.05), np.float32(0.0)))
    return tuple(layers), samples.walls(samples.wall(frame, depth_m=depth_m), buffer_m=0.1)


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize(
    ("rule", "shape"),
    [
        *(("best-view", (41, 58)), ("voronoi", (41, 58)), ("priority", (41, 58))),
        # Cut at full scale, and at a half and a third of it, which do not divide the sides evenly.
        *(("graph-cut", (41, 58)), ("graph-cut", (205, 170))),
    ],
)
def test_turned_layers_are_joined_along_turned_seams(
    tmp_path: Path, rule: str, shape: tuple[int, int], turn: Turn
) -> None:
    found = []
    for each in (TURNS[0], turn):
        layers, walls = three_discs(shape, each)
        first = {"priority": ["photo 2"]} if rule == "priority" else {}
        options = {"seams": rule, "island_cells_min": 100, **first}
        found.append(image_of(tmp_path, *layers, inputs={"walls": walls}, **options))
    image, turned = found
    assert len(np.unique(image.source)) >= 3
    for name in ("source", "mask", "rgb"):
        np.testing.assert_array_equal(getattr(turned, name), turn.raster(getattr(image, name)))


# --- seams drawn by hand ---

DISCS, _ = three_discs((41, 58))


def along(*files: Path, folder: Path, **params: Any) -> Orthoimage:
    drawn = InputFiles(name="seams", paths=files) if files else None
    return image_of(folder, *DISCS, inputs={"seams": drawn}, **params)


def drawn(folder: Path, photo: str, ring: list[list[float]], wall: object = 0) -> Path:
    area = {
        "type": "Feature",
        "properties": {"photo": photo, "wall": wall},
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
    }
    path = folder / "drawn.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [area]}))
    return path


@pytest.mark.parametrize("rule", ["best-view", "voronoi", "graph-cut"])
def test_written_seams_give_the_same_mosaic_whatever_the_rule(tmp_path: Path, rule: str) -> None:
    first = along(folder=tmp_path, seams="priority", priority=["photo 2", "photo 1"])
    assert len(np.unique(first.source)) >= 2
    path = tmp_path / "wall_0_seams.geojson"
    write_seams_geojson(path, first)
    again = along(path, folder=tmp_path, seams=rule)
    np.testing.assert_array_equal(again.source, first.source)
    assert (along(folder=tmp_path, seams=rule).source == first.source).mean() < 0.8


def test_a_drawn_area_takes_its_photo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = along(folder=tmp_path)
    gsd_m = before.frame.gsd_m
    # The ring contains rows 5 to 19 and columns 10 to 39; X is to the right, Y upwards from the
    # top-left corner.
    ring = [[10.2, -5.2], [39.8, -5.2], [39.8, -19.8], [10.2, -19.8]]
    path = drawn(tmp_path, "photo 1", [[x * gsd_m, y * gsd_m] for x, y in ring])
    after = along(path, folder=tmp_path)
    area = np.s_[5:20, 10:40]
    paints = DISCS[1].mask[area] == LayerMask.PAINTED
    assert paints.any()
    assert (after.source[area] == np.where(paints, 1, before.source[area])).all()
    outside = np.ones(after.source.shape, dtype=np.bool_)
    outside[4:21, 9:41] = False
    np.testing.assert_array_equal(after.source[outside], before.source[outside])
    shown = after.mask == OrthoMask.PAINTED
    own = np.choose(after.source[..., None].clip(0), [layer.rgb for layer in DISCS])
    np.testing.assert_array_equal(after.rgb[shown], own[shown])
    # Bands do not affect the result.
    monkeypatch.setattr(joining, "BAND_CELLS", 1)
    np.testing.assert_array_equal(along(path, folder=tmp_path).source, after.source)
    # Polygons of another wall have no effect.
    other = drawn(tmp_path, "photo 1", [[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]], wall=3)
    np.testing.assert_array_equal(along(other, folder=tmp_path).source, before.source)


@pytest.mark.parametrize(
    ("photo", "wall", "said"),
    [
        ("photo 9", 0, "refer to the photo photo 9, but the layers come from photo 0, photo 1"),
        ("photo 1", "west", 'needs the property "wall", the number of a wall; got'),
    ],
)
def test_impossible_seams_are_refused(tmp_path: Path, photo: str, wall: object, said: str) -> None:
    path = drawn(tmp_path, photo, [[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]], wall=wall)
    with pytest.raises(InputError, match=said):
        along(path, folder=tmp_path)
