"""Seams that a person drew override the rules, and come back as they were written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.mosaic.seams import MosaicSeams

from orthoflow.errors import InputError
from orthoflow.files.drawings.geojson import write_seams_geojson
from orthoflow.products import InputFiles, Layers, Orthoimage, OrthoMask
from tests import raster_scenes as scenes
from tests.plugins.mosaic.test_turned_seams import layers_and_walls
from tests.turns import TURNS

SHAPE = (41, 58)


def layers() -> Layers:
    return layers_and_walls(SHAPE, TURNS[0])[0]


def mosaic(folder: Path, *files: Path, **params: object) -> Orthoimage:
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
    first = mosaic(tmp_path, seams="priority", priority=["photo 2", "photo 1"])
    assert len(np.unique(first.source)) >= 2
    path = tmp_path / "wall_0_seams.geojson"
    write_seams_geojson(path, first)
    again = mosaic(tmp_path, path, seams=seams)
    np.testing.assert_array_equal(again.source, first.source)
    assert (mosaic(tmp_path, seams=seams).source == first.source).mean() < 0.8


def test_an_area_takes_the_photo_that_is_drawn_where_it_paints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = mosaic(tmp_path)
    gsd_m = before.frame.gsd_m
    # Rows 5 to 19 and columns 10 to 39; X to the right, Y upwards from the top-left corner.
    ring = [[10.2, -5.2], [39.8, -5.2], [39.8, -19.8], [10.2, -19.8]]
    path = drawn(tmp_path, ("photo 1", [[x * gsd_m, y * gsd_m] for x, y in ring]))
    after = mosaic(tmp_path, path)
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
    np.testing.assert_array_equal(mosaic(tmp_path, path).source, after.source)
    # Another wall's polygons change nothing.
    other = drawn(tmp_path, ("photo 1", [[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]]), wall=3)
    np.testing.assert_array_equal(mosaic(tmp_path, other).source, before.source)


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
        mosaic(tmp_path, path)
