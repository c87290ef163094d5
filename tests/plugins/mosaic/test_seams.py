"""`mosaic.seams`: one layer passes through, of several the best paints each cell, by each rule."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.mosaic import seams
from orthoflow_plugins.mosaic.agreement import count_seams
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.errors import InputError, MethodError
from orthoflow.files.drawing import plane_ink
from orthoflow.files.drawings.geojson import write_seams_geojson
from orthoflow.files.geotiff import read_raster
from orthoflow.files.images import decode_image
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.geometry import WallFrame, frame_over
from orthoflow.products import (
    Camera,
    Cameras,
    InputFiles,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Wall,
    Walls,
)
from tests import inspect_scenes, samples
from tests import raster_scenes as scenes
from tests.turns import OTHER_TURNS, TURNS, Turn


def frame(shape: tuple[int, int] = (6, 8)) -> WallFrame:
    known = scenes.upright_wall(shape=shape)
    return frame_over(known.planes().corners[0], known.normal, gsd_m=known.gsd_m)


def random_layer(seed: int, *, wall: int = 0, filled: bool = True) -> Layer:
    rng = np.random.default_rng(seed)
    shape = frame().shape
    mask = rng.integers(0, 4, shape, dtype=np.uint8)
    is_painted = mask == LayerMask.PAINTED
    return Layer(
        frame=frame(),
        wall=wall,
        source=f"photo {seed}",
        rgb=np.where(is_painted[..., None], rng.integers(0, 256, (*shape, 3)), 0).astype(np.uint8),
        mask=mask,
        quality=np.where(is_painted, rng.random(shape), 0.0).astype(np.float32),
        filled=(is_painted & (rng.random(shape) < 0.3)).astype(np.uint8) if filled else None,
    )


def joined(layers: Layers, folder: Path, *, island_cells_min: int = 1) -> Orthoimages:
    params = MosaicSeams.Params(island_cells_min=island_cells_min, gains="none")
    ctx = scenes.context(folder)
    return MosaicSeams().run(MosaicSeams.In(layers=layers), params, ctx).orthoimages


def test_a_single_layer_passes_through(tmp_path: Path) -> None:
    layer = random_layer(1)
    (image,) = joined(Layers(layers=(layer,), names=("west wall",)), tmp_path).images
    np.testing.assert_array_equal(image.rgb, layer.rgb)
    table = {
        LayerMask.OUTSIDE: OrthoMask.NONE,
        LayerMask.OCCLUDED: OrthoMask.OCCLUDED,
        LayerMask.NO_SURFACE: OrthoMask.NO_SURFACE,
    }
    for state, expected in table.items():
        assert (image.mask[layer.mask == state] == expected).all()
    assert layer.filled is not None
    is_painted = layer.mask == LayerMask.PAINTED
    assert (image.mask[layer.filled > 0] == OrthoMask.FILLED).all()
    assert (image.mask[is_painted & (layer.filled == 0)] == OrthoMask.PAINTED).all()
    np.testing.assert_array_equal(image.source == 0, is_painted)
    assert (image.source[~is_painted] == -1).all()
    assert image.name == "west wall"
    assert image.sources == ("photo 1",)


def test_every_wall_of_the_layers_gets_an_orthoimage(tmp_path: Path) -> None:
    layers = Layers(
        layers=(random_layer(1, wall=0), random_layer(2, wall=2), random_layer(3, wall=0)),
        names=("a", "b", "c"),
    )
    images = joined(layers, tmp_path).images
    assert [(image.wall, image.name, len(image.sources)) for image in images] == [
        (0, "a", 2),
        (2, "c", 1),
    ]


def test_no_layers_give_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match="no layer to make"):
        joined(Layers(layers=()), tmp_path)


def share(mask: NDArray[np.uint8], state: OrthoMask) -> float:
    return float(np.mean(mask == state))


def test_shares_of_all_states_are_reported(tmp_path: Path) -> None:
    layers = Layers(layers=(random_layer(1), random_layer(2)))
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=layers)
    params = MosaicSeams.Params(island_cells_min=1, gains="none")
    (image,) = MosaicSeams().run(inputs, params, ctx).orthoimages.images
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics.pop("n_orthoimages") == 1
    assert metrics.pop("n_sources") == 2
    assert metrics.pop("n_overlap_patches") == 0
    # Colours of chance contradict each other nowhere over a region.
    assert metrics.pop("outvoted_share") == metrics["contradicted_share"] == 0.0
    n_seam, _ = count_seams(image.source, None)
    assert n_seam > 0
    assert metrics.pop("seam_share") == n_seam / np.count_nonzero(image.source >= 0)
    # Colours of chance: their differences have a standard deviation of 70 grey levels.
    assert 20.0 < metrics.pop("seam_step_rms_grey") < 150.0
    assert metrics.pop("seam_step_mean_delta_e") > 10.0
    expected = {f"{state.name.lower()}_share": share(image.mask, state) for state in OrthoMask}
    assert metrics == pytest.approx(expected)


def smooth_layer(
    name: str, quality: NDArray[np.float32], mask: NDArray[np.uint8], *, rgb: int = 7
) -> Layer:
    is_painted = mask == LayerMask.PAINTED
    return samples.layer(
        mask,
        frame=frame(mask.shape),
        source=name,
        rgb=np.where(is_painted[..., None], np.uint8(rgb), np.uint8(0)) * np.ones(3, np.uint8),
        quality=np.where(is_painted, quality, np.float32(0.0)),
    )


def two_halves() -> tuple[Layer, Layer]:
    """The first is better on the left of 40 columns, the second on the right, both a bit noisy."""
    shape = (30, 40)
    columns = np.mgrid[: shape[0], : shape[1]][1].astype(np.float32)
    noise = np.random.default_rng(3).normal(0.0, 4.0, shape).astype(np.float32)
    whole = np.full(shape, LayerMask.PAINTED, dtype=np.uint8)
    return (
        smooth_layer("left", 50.0 - columns, whole, rgb=10),
        smooth_layer("right", 11.0 + columns + noise, whole, rgb=20),
    )


def n_patches(source: NDArray[np.int16]) -> int:
    import cv2

    counts = [
        cv2.connectedComponents((source == index).astype(np.uint8), connectivity=4)[0] - 1
        for index in np.unique(source)
    ]
    return sum(counts)


def test_noisy_qualities_do_not_give_specks(tmp_path: Path) -> None:
    layers = Layers(layers=two_halves())
    (specks,) = joined(layers, tmp_path).images
    (calm,) = joined(layers, tmp_path, island_cells_min=100).images
    assert n_patches(specks.source) > 10
    assert n_patches(calm.source) == 2
    np.testing.assert_array_equal(calm.mask, specks.mask)
    np.testing.assert_array_equal(calm.rgb[..., 0], np.where(calm.source == 0, 10, 20))


def test_a_filling_is_not_enlarged_over_painted_cells(tmp_path: Path) -> None:
    left, right = two_halves()
    filled = np.ones_like(left.mask)
    filled[10:14, 5:9] = 0
    left = dataclasses.replace(left, filled=filled)
    few = np.full_like(right.mask, LayerMask.OUTSIDE)
    few[20:24, 5:9] = LayerMask.PAINTED
    right = smooth_layer("right", right.quality, few, rgb=20)
    (image,) = joined(Layers(layers=(left, right)), tmp_path, island_cells_min=100).images
    assert (image.source[20:24, 5:9] == 1).all()
    assert (image.mask[20:24, 5:9] == OrthoMask.PAINTED).all()
    assert (image.mask[10:14, 5:9] == OrthoMask.PAINTED).all()
    assert np.count_nonzero(image.mask == OrthoMask.FILLED) == image.mask.size - 32


def test_a_wall_that_nothing_paints_is_empty_and_that_is_said(tmp_path: Path) -> None:
    mask = np.full((30, 40), LayerMask.OCCLUDED, dtype=np.uint8)
    mask[:5], mask[5:9] = LayerMask.OUTSIDE, LayerMask.NO_SURFACE
    layer = smooth_layer("no photo", np.zeros((30, 40), dtype=np.float32), mask)
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=Layers(layers=(layer,), names=("west",)))
    (image,) = MosaicSeams().run(inputs, MosaicSeams.Params(), ctx).orthoimages.images
    assert ctx.warnings == ["the orthoimage of west is empty: no source shows it"]
    assert image.sources == ()
    assert (image.source == -1).all()
    assert (image.mask[:5] == OrthoMask.NONE).all()
    assert (image.mask[5:9] == OrthoMask.NO_SURFACE).all()
    assert (image.mask[9:] == OrthoMask.OCCLUDED).all()


@pytest.mark.parametrize(
    ("missing", "n_rows", "no_surface", "n_refused", "causes"),
    [
        # Causes of a hundredth of the cells are named.
        (LayerMask.OUTSIDE, 10, 15, None, ["25% are in no oriented photo (check which"]),
        (LayerMask.OCCLUDED, 10, 17, None, ["25% are hidden in all photos", "1% have no surface"]),
        # A new photo is asked for only where none was refused.
        (LayerMask.OUTSIDE, 10, 0, 0, ["25% are in no oriented photo (take another"]),
        (LayerMask.OUTSIDE, 10, 0, 2, ["25% are in no oriented photo (2 of 3 photos are not"]),
        # A tenth at least is missing, apart from what has no surface.
        (LayerMask.OUTSIDE, 3, 800, None, None),
    ],
    ids=["no photo", "hidden", "all oriented", "two refused", "no surface"],
)
def test_empty_cells_are_reported_with_their_causes(
    tmp_path: Path,
    missing: LayerMask,
    n_rows: int,
    no_surface: int,
    n_refused: int | None,
    causes: list[str] | None,
) -> None:
    mask = np.full((40, 40), LayerMask.PAINTED, dtype=np.uint8)
    mask[:n_rows], mask.ravel()[mask.size - no_surface :] = missing, LayerMask.NO_SURFACE
    layer = smooth_layer("one", np.ones((40, 40), dtype=np.float32), mask)
    cameras = None
    if n_refused is not None:
        states = ["ok", *["too few ties"] * n_refused]
        cameras = Cameras(
            cameras=tuple(Camera(photo=f"{k}", status=state) for k, state in enumerate(states))
        )
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=Layers(layers=(layer,), names=("west",)), cameras=cameras)
    MosaicSeams().run(inputs, MosaicSeams.Params(), ctx)
    found = [one.values for one in ctx.diagnostics if one.code == "orthoimage-cells-empty"]
    assert len(found) == (causes is not None)
    if causes is not None:
        assert found[0]["share"] == 0.25 + no_surface / 1600
        stated = found[0]["causes"].split("; ")
        assert [one.startswith(two) for one, two in zip(stated, causes, strict=True)] == [
            True
        ] * len(causes)


def test_a_layer_without_paint_is_no_source_but_tells_what_is_hidden(tmp_path: Path) -> None:
    left, right = two_halves()
    blind = smooth_layer("blind", left.quality, np.full_like(left.mask, LayerMask.OCCLUDED))
    few = left.mask.copy()
    few[:, 20:] = LayerMask.OUTSIDE
    left = smooth_layer("left", left.quality, few, rgb=10)
    del right
    (image,) = joined(Layers(layers=(blind, left)), tmp_path).images
    assert image.sources == ("left",)
    assert (image.source[:, :20] == 0).all()
    assert (image.mask[:, 20:] == OrthoMask.OCCLUDED).all()


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-3, 4)], ids=str)
def test_displacements_between_photos_are_measured(tmp_path: Path, shift: tuple[int, int]) -> None:
    import cv2

    noise = np.random.default_rng(2).integers(0, 256, (400, 400), np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    u, v = shift
    pictures = [texture[50:350, 50:350], texture[50 - v : 350 - v, 50 - u : 350 - u]]
    layers = [
        dataclasses.replace(
            smooth_layer(f"{k}", np.ones((300, 300), np.float32), np.ones((300, 300), np.uint8)),
            rgb=np.dstack([picture] * 3),
        )
        for k, picture in enumerate(pictures)
    ]
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=Layers(layers=tuple(layers)))
    MosaicSeams().run(inputs, MosaicSeams.Params(), ctx)
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    assert metrics["n_overlap_patches"] == 16
    assert metrics["overlap_u_rms_cells"] == pytest.approx(abs(u), abs=0.15)
    assert metrics["overlap_v_rms_cells"] == pytest.approx(abs(v), abs=0.15)
    cell_mm = 1e3 * layers[0].frame.gsd_m
    for axis in "uv":
        in_cells = metrics[f"overlap_{axis}_rms_cells"]
        assert metrics[f"overlap_{axis}_rms_mm"] == pytest.approx(cell_mm * in_cells)


@pytest.mark.usefixtures("charts")
def test_the_map_of_sources_has_a_colour_for_each(tmp_path: Path) -> None:
    ctx = scenes.context(tmp_path)
    inputs = MosaicSeams.In(layers=Layers(layers=two_halves(), names=("west",)))
    MosaicSeams().run(inputs, MosaicSeams.Params(), ctx)
    (figure,) = ctx.figures
    picture = decode_image(figure.path.read_bytes()).astype(float)
    top = picture[20 : picture.shape[0] // 3]
    for middle, index in ((0.3, 0), (0.7, 1)):
        shown = top[:, round(middle * top.shape[1])].mean(axis=0)
        ink = np.array(plane_ink(index))
        # The tint lies on grey: its channels keep their order.
        np.testing.assert_array_equal(np.argsort(shown), np.argsort(ink, kind="stable"))


def test_layers_are_published_when_asked_for(tmp_path: Path) -> None:
    named = ("b/a b.jpg", "c/a b.jpg")
    layers = [dataclasses.replace(random_layer(k), source=name) for k, name in enumerate(named)]
    inputs = MosaicSeams.In(layers=Layers(layers=tuple(layers), names=("west wall",)))
    ctx = scenes.context(tmp_path)
    assert MosaicSeams().run(inputs, MosaicSeams.Params(), ctx).orthoimages.layers is None
    params = MosaicSeams.Params(publish_layers=True)
    asked = MosaicSeams().run(inputs, params, scenes.context(tmp_path)).orthoimages
    publish_orthoimages(Orthoimages.from_payload(asked.to_payload()), tmp_path, "digest")
    for number, layer in enumerate(layers):
        stem = f"wall_0_layer_{number}_a-b"
        raster = read_raster(tmp_path / f"{stem}.tif")
        np.testing.assert_array_equal(raster.values, layer.rgb)
        np.testing.assert_array_equal(raster.shown, layer.mask == LayerMask.PAINTED)
        said = json.loads((tmp_path / f"{stem}.json").read_text())
        assert (said["source"], said["name"]) == (layer.source, "west wall")
        assert sum(said["mask_counts"].values()) == layer.mask.size


def test_gains_and_what_a_lens_loses_in_its_corners_are_told(tmp_path: Path) -> None:
    def joined_with(exposures: list[list[float]], lenses: list[list[float]]) -> Any:
        of = SimpleNamespace(exposures=np.log(exposures), lenses=np.array(lenses).reshape(-1, 2))
        return SimpleNamespace(balance=SimpleNamespace(exposures=of))

    untouched: Any = SimpleNamespace(balance=None)
    # In the corners r is 1: both terms add up in the logarithm of what has to be made good.
    verdicts = [
        joined_with([[0.8, 1.0, 1.1], [1.2, 0.9, 1.0]], [[0.1, 0.2], [0.0, 0.05]]),
        untouched,
        joined_with([[1.0, 1.4, 1.0]], []),
    ]
    ctx = scenes.context(tmp_path)
    seams._report_gains(ctx, verdicts)
    assert {metric.name: metric.value for metric in ctx.metrics} == {
        "gain_min": pytest.approx(0.8),
        "gain_max": pytest.approx(1.4),
        "lens_loss_share": pytest.approx(1.0 - np.exp(-0.3)),
    }
    for few, names in (([untouched], set()), (verdicts[2:], {"gain_min", "gain_max"})):
        ctx = scenes.context(tmp_path)
        seams._report_gains(ctx, few)
        assert {metric.name for metric in ctx.metrics} == names


@pytest.mark.parametrize(("rgb", "tone"), [(2, "black"), (254, "white"), (128, "one value")])
def test_an_orthoimage_of_one_tone_is_reported(tmp_path: Path, rgb: int, tone: str) -> None:
    mask = np.full((60, 50), LayerMask.PAINTED, dtype=np.uint8)
    layer = smooth_layer("dark.jpg", np.ones((60, 50), dtype=np.float32), mask, rgb=rgb)
    ctx = scenes.context(tmp_path)
    MosaicSeams().run(
        MosaicSeams.In(layers=Layers(layers=(layer,), names=("west",))), MosaicSeams.Params(), ctx
    )
    (found,) = [one for one in ctx.diagnostics if one.code == "orthoimage-of-one-tone"]
    assert f"is {tone}" in found.text
    assert "dark.jpg" in found.text


WIDE = (40, 120)


def layer(
    name: str, columns: tuple[int, int], rgb: NDArray[np.uint8] | int, quality: float = 1.0
) -> Layer:
    """A layer that paints some columns of the wall."""
    colour = np.broadcast_to(np.asarray(rgb, dtype=np.uint8), (*WIDE, 3))
    return inspect_scenes.painted_layer(name, slice(*columns), colour, quality)


def joined_wide(
    folder: Path, *layers: Layer, walls: Walls | None = None, **params: object
) -> tuple[Orthoimage, dict[str, float], dict[str, object]]:
    ctx = scenes.context(folder)
    out = MosaicSeams().run(
        MosaicSeams.In(layers=Layers(layers=layers), walls=walls),
        MosaicSeams.Params.model_validate({"island_cells_min": 1, "gains": "none"} | params),
        ctx,
    )
    metrics = {metric.name: metric.value for metric in ctx.metrics}
    return out.orthoimages.images[0], metrics, dict(out.orthoimages.details)


def seam_columns(image: Orthoimage) -> NDArray[np.int64]:
    """First column of the second source in each row."""
    return np.argmax(image.source == 1, axis=1)


def textures() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two pictures that agree in columns 64 to 67 only."""
    rng = np.random.default_rng(4)
    one, other = (rng.integers(0, 256, (*WIDE, 3)).astype(np.uint8) for _ in range(2))
    other[:, 64:68] = one[:, 64:68]
    return one, other


def test_a_graph_cut_runs_where_the_photos_agree(tmp_path: Path) -> None:
    one, other = textures()
    left, right = layer("left", (0, 100), one), layer("right", (20, 120), other)
    image, cut, _ = joined_wide(tmp_path, left, right, seams="graph-cut")
    columns = seam_columns(image)
    assert ((columns >= 65) & (columns <= 67)).all()
    assert cut["seam_step_rms_grey"] == 0.0
    assert cut["seam_step_mean_delta_e"] == 0.0
    assert (image.source[:, :65] == 0).all()
    _, middle, _ = joined_wide(tmp_path, left, right, seams="voronoi")
    assert middle["seam_step_rms_grey"] > 40.0


def test_a_graph_cut_keeps_off_depth_edges(tmp_path: Path) -> None:
    left, right = layer("left", (0, 100), 10), layer("right", (20, 120), 10)
    depth = np.zeros(WIDE, dtype=np.float32)
    depth[:, 60:63] = 0.1
    wall = inspect_scenes.walls().walls[0]
    small = {
        field.name: getattr(wall, field.name)[: WIDE[0], : WIDE[1]]
        for field in dataclasses.fields(Wall)
        if isinstance(getattr(wall, field.name), np.ndarray)
    }
    stepped = dataclasses.replace(
        wall, frame=left.frame, **(small | {"depth_m": depth, "intensity": None})
    )
    walls = dataclasses.replace(inspect_scenes.walls(), walls=(stepped,))
    _, cut, _ = joined_wide(tmp_path, left, right, walls=walls, seams="graph-cut")
    assert cut["seam_on_depth_edge_share"] == 0.0
    # The first photo is better up to where it ends, and that is where the edge is moved to.
    depth[:] = 0.0
    depth[:, 100:] = 0.1
    _, best, _ = joined_wide(tmp_path, left, right, walls=walls)
    assert best["seam_on_depth_edge_share"] == 1.0


SHAPE = (41, 58)


def layers() -> Layers:
    return layers_and_walls(SHAPE, TURNS[0])[0]


def joined_drawn(folder: Path, *files: Path, **params: object) -> Orthoimage:
    inputs = MosaicSeams.In(
        layers=layers(), seams=InputFiles(name="seams", paths=files) if files else None
    )
    chosen = MosaicSeams.Params.model_validate({"island_cells_min": 1, "gains": "none"} | params)
    return MosaicSeams().run(inputs, chosen, scenes.context(folder)).orthoimages.images[0]


def drawn(folder: Path, *areas: tuple[str, list[list[float]]], wall: object = 0) -> Path:
    features = [
        {
            "type": "Feature",
            "properties": {"photo": photo, "wall": wall},
            "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
        }
        for photo, ring in areas
    ]
    path = folder / "drawn.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.mark.parametrize("seams", ["best-view", "voronoi", "graph-cut"])
def test_written_seams_give_the_same_mosaic_whatever_the_rule(tmp_path: Path, seams: str) -> None:
    first = joined_drawn(tmp_path, seams="priority", priority=["photo 2", "photo 1"])
    assert len(np.unique(first.source)) >= 2
    path = tmp_path / "wall_0_seams.geojson"
    write_seams_geojson(path, first)
    again = joined_drawn(tmp_path, path, seams=seams)
    np.testing.assert_array_equal(again.source, first.source)
    assert (joined_drawn(tmp_path, seams=seams).source == first.source).mean() < 0.8


def test_an_area_takes_the_photo_that_is_drawn_where_it_paints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = joined_drawn(tmp_path)
    gsd_m = before.frame.gsd_m
    # Rows 5 to 19 and columns 10 to 39; X to the right, Y upwards from the top-left corner.
    ring = [[10.2, -5.2], [39.8, -5.2], [39.8, -19.8], [10.2, -19.8]]
    path = drawn(tmp_path, ("photo 1", [[x * gsd_m, y * gsd_m] for x, y in ring]))
    after = joined_drawn(tmp_path, path)
    area = np.s_[5:20, 10:40]
    paints = layers().layers[1].mask[area] == 1
    assert paints.any()
    assert (after.source[area] == np.where(paints, 1, before.source[area])).all()
    outside = np.ones(SHAPE, dtype=np.bool_)
    outside[4:21, 9:41] = False
    np.testing.assert_array_equal(after.source[outside], before.source[outside])
    shown = after.mask == OrthoMask.PAINTED
    own = np.choose(after.source[..., None].clip(0), [layer.rgb for layer in layers().layers])
    np.testing.assert_array_equal(after.rgb[shown], own[shown])
    # Bands do not show.
    monkeypatch.setattr("orthoflow_plugins.mosaic.joining._BAND_CELLS", 1)
    np.testing.assert_array_equal(joined_drawn(tmp_path, path).source, after.source)
    # Another wall's polygons change nothing.
    other = drawn(tmp_path, ("photo 1", [[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]]), wall=3)
    np.testing.assert_array_equal(joined_drawn(tmp_path, other).source, before.source)


@pytest.mark.parametrize(
    ("photo", "wall", "said"),
    [
        ("photo 9", 0, "refer to the photo photo 9, but the layers are of photo 0, photo 1"),
        ("photo 1", "west", 'needs the property "wall", the number of a wall; got'),
    ],
)
def test_seams_that_fit_no_layer_are_refused(
    tmp_path: Path, photo: str, wall: object, said: str
) -> None:
    path = drawn(tmp_path, (photo, [[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]]), wall=wall)
    with pytest.raises(InputError, match=said):
        joined_drawn(tmp_path, path)


def layers_and_walls(shape: tuple[int, int], turn: Turn) -> tuple[Layers, Walls]:
    import cv2

    rng = np.random.default_rng(3)
    frame = inspect_scenes.frame(shape=turn.shape(shape))
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    layers = []
    for k, (at_row, at_column) in enumerate(rng.uniform(0.2, 0.8, (3, 2)) * shape):
        distance = np.hypot(rows - at_row, columns - at_column)
        is_painted = distance < 0.6 * max(shape)
        grey = cv2.GaussianBlur(rng.normal(0.0, 1.0, (*shape, 3)), (0, 0), 3.0)
        rgb = np.clip(128.0 + 300.0 * grey + 10.0 * k, 0, 255).astype(np.uint8)
        quality = np.where(is_painted, 1.0 / (1.0 + distance), 0.0).astype(np.float32)
        layers.append(
            Layer(
                frame=frame,
                wall=0,
                source=f"photo {k}",
                rgb=turn.raster(np.where(is_painted[..., None], rgb, np.uint8(0))),
                mask=turn.raster(
                    np.where(is_painted, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8)
                ),
                quality=turn.raster(quality),
            )
        )
    is_near = np.hypot(rows - 0.5 * shape[0], columns - 0.4 * shape[1]) < 0.2 * min(shape)
    depth_m = np.where(is_near, np.float32(0.05), np.float32(0.0))
    wall = samples.wall(
        frame, depth_m=turn.raster(depth_m), mask=np.ones(frame.shape, dtype=np.uint8)
    )
    walls = samples.walls(wall, buffer_m=0.1)
    return Layers(layers=tuple(layers), names=("wall 0",)), walls


def joined_turned(shape: tuple[int, int], turn: Turn, folder: Path, **params: object) -> Orthoimage:
    layers, walls = layers_and_walls(shape, turn)
    chosen = MosaicSeams.Params.model_validate(params)
    inputs = MosaicSeams.In(layers=layers, walls=walls)
    return MosaicSeams().run(inputs, chosen, scenes.context(folder)).orthoimages.images[0]


@pytest.mark.parametrize("turn", OTHER_TURNS, ids=str)
@pytest.mark.parametrize(
    ("seams", "shape"),
    [
        ("best-view", (41, 58)),
        ("voronoi", (41, 58)),
        ("priority", (41, 58)),
        ("graph-cut", (41, 58)),
        # Cut at half and a third of the size, which does not go into the sides.
        ("graph-cut", (205, 170)),
    ],
)
def test_turned_layers_are_joined_along_turned_seams(
    tmp_path: Path, seams: str, shape: tuple[int, int], turn: Turn
) -> None:
    params = {
        "seams": seams,
        "priority": ["photo 2"] if seams == "priority" else [],
        "gains": "none",
    }
    image = joined_turned(shape, TURNS[0], tmp_path, **params)
    turned = joined_turned(shape, turn, tmp_path, **params)
    assert len(np.unique(image.source)) >= 3
    np.testing.assert_array_equal(turned.source, turn.raster(image.source))
    np.testing.assert_array_equal(turned.mask, turn.raster(image.mask))
    np.testing.assert_array_equal(turned.rgb, turn.raster(image.rgb))
