"""What an export of a cloud writes: which points, by which colours, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rasterio.crs import CRS

from orthoflow.cli.exports import clouds as module
from orthoflow.cli.exports.choices import Choices
from orthoflow.errors import ArgumentError
from orthoflow.files.clouds.attributes import AttributedCloud
from orthoflow.products import (
    Camera,
    Cameras,
    Photo,
    Photos,
    Planes,
    PointCloud,
    PointLabels,
    Product,
    Surfaces,
)
from tests import samples
from tests.report_runs import HeldRun, cameras_product, cell, given, run_of

N_SIDE = 12


def cloud(**more: Any) -> PointCloud:
    a, b = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, 1.0, N_SIDE)] * 2))
    x, y = (np.ascontiguousarray(axis, np.float32) for axis in (a, b))
    plain = {"intensity": np.linspace(0.0, 1.0, len(x), dtype=np.float32)}
    up = np.array([0.0, 0.0, 1.0])
    return PointCloud(origin=np.zeros(3), x=x, y=y, z=np.zeros_like(x), up=up, **(plain | more))


def planes() -> Planes:
    corners = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]])
    return samples.planes(
        normal=np.array([[0.0, 0.0, 1.0]]),
        offset=np.zeros(1),
        corners=corners,
        n_points=np.array([1]),
        names=("floor",),
    )


def labels(n_points: int = N_SIDE**2) -> PointLabels:
    return PointLabels(plane_index=np.zeros(n_points, np.int16))


def toy_run(**cells: tuple[Mapping[str, str], Mapping[str, Product]]) -> HeldRun:
    """A run of steps: which step gives each input, and the products that each gives, by port."""
    held = {(step, port): one for step, (_, made) in cells.items() for port, one in made.items()}
    outputs = {
        place: given("", chr(97 + number), one.type_name)
        for number, (place, one) in enumerate(held.items())
    }
    recorded = [
        cell(
            step,
            inputs={port: outputs[source, port.rstrip("2")] for port, source in taken.items()},
            outputs={port: outputs[step, port] for port in made},
        )
        for step, (taken, made) in cells.items()
    ]
    return run_of(*recorded, products=held)


def labelled(of: PointCloud | None = None, marks: PointLabels | None = None) -> HeldRun:
    return toy_run(
        scan=({}, {"cloud": of or cloud()}),
        plane=({"cloud": "scan"}, {"planes": planes(), "labels": marks or labels()}),
    )


def exported(folder: Path, run: Any, **choices: Any) -> tuple[str, AttributedCloud]:
    """What is said, and what would be written."""
    kept: list[AttributedCloud] = []

    def write(path: Path, attributed: AttributedCloud) -> int:
        kept.append(attributed)
        path.touch()
        return sum(len(block) for block in attributed.blocks())

    said = module.export_cloud("cloud.toy", write, run, folder, Choices(**choices))
    (attributed,) = kept
    return said, attributed


def test_a_box_leaves_points_out_and_says_so(tmp_path: Path) -> None:
    # Corners in any order.
    said, attributed = exported(tmp_path, labelled(), box="0.5,1,1,0,0,-1")
    assert said == "cloud.toy: 72 points of 144 coloured by intensity, cloud of plane"
    np.testing.assert_array_equal(attributed.box_world, [[0.0, 0.0, -1.0], [0.5, 1.0, 1.0]])
    with pytest.raises(
        ArgumentError, match=r"^no points of the cloud of plane are selected: choose"
    ):
        exported(tmp_path, labelled(), box="5,5,5,6,6,6")
    for box in ("1,2,3,4,5", "a,2,3,4,5,6", "1,2,nan,4,5,6"):
        with pytest.raises(ArgumentError, match="--box must be six numbers in metres"):
            exported(tmp_path, labelled(), box=box)


def test_points_on_curved_surfaces_deviate_from_no_plane(tmp_path: Path) -> None:
    (one,) = samples.surfaces().surfaces[:1]
    found = Surfaces(surfaces=(replace(one, name="vault 1"),), up=one.zero_world, planes=planes())
    marks = PointLabels(plane_index=(np.arange(N_SIDE**2) % 3 - 1).astype(np.int16))
    made: dict[str, Product] = {"surfaces": found, "labels": marks}
    scanned = replace(cloud(), stations=None)
    run = toy_run(scan=({}, {"cloud": scanned}), curved=({"cloud": "scan"}, made))
    (block,) = exported(tmp_path, run, colour="deviation")[1].blocks()
    np.testing.assert_array_equal(np.isfinite(block["deviation"]), block["plane"] == 0)
    assert (block["nz"][block["plane"] == 1] >= 0.0).all()


@pytest.mark.parametrize(
    ("more", "can_show"),
    [
        ({"rgb": np.zeros((N_SIDE**2, 3), np.uint8)}, "rgb intensity plane deviation"),
        ({"intensity": None}, "plane deviation"),
    ],
)
def test_the_best_colours_that_there_are_come_first(
    tmp_path: Path, more: dict[str, Any], can_show: str
) -> None:
    run = labelled(replace(cloud(), **more))
    assert exported(tmp_path, run)[1].colouring == can_show.split(maxsplit=1)[0]
    for colour in can_show.split():
        assert exported(tmp_path, run, colour=colour)[1].colouring == colour
    with pytest.raises(ArgumentError) as caught:
        exported(tmp_path, run, colour="photos")
    assert str(caught.value).endswith("; available: " + ", ".join(can_show.split()))


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    bare = replace(cloud(), intensity=None)
    made: dict[str, Product] = {"planes": planes(), "labels": labels()}
    turned = toy_run(
        scan=({}, {"cloud": bare}),
        plane=({"cloud": "scan"}, made),
        orient=({}, {"cameras": cameras_product()}),
    )
    # Photos that the run oriented are named, though they were not read.
    with pytest.raises(ArgumentError, match=r"available: photos, plane, deviation$"):
        exported(folder, turned, colour="intensity")
    grey = toy_run(scan=({}, {"cloud": bare}))
    with pytest.raises(ArgumentError, match="of scan has no colours, intensities or planes"):
        exported(folder, grey)
    none = np.zeros(0, np.float32)
    empty = PointCloud(origin=np.zeros(3), x=none, y=none, z=none, up=np.array([0.0, 0.0, 1.0]))
    with pytest.raises(ArgumentError, match="the cloud of scan has no points"):
        exported(folder, toy_run(scan=({}, {"cloud": empty})))
    with pytest.raises(ArgumentError, match=r"^the labels have 9 points, but the cloud has 144$"):
        exported(folder, labelled(marks=labels(9)))
    two = toy_run(
        scan=({}, {"cloud": cloud()}),
        plane=({"cloud": "scan", "cloud2": "scan"}, {"labels": labels()}),
    )
    with pytest.raises(
        ArgumentError,
        match="it is unknown to which of 2 input clouds the labels of plane belong",
    ):
        exported(folder, two)
    with pytest.raises(ArgumentError, match="--wall 3: the run has no wall 3; it has none"):
        exported(folder, labelled(), wall=3)
    assert not folder.exists()


def test_the_coordinate_system_is_written_where_all_walls_agree() -> None:
    def walls(*names: str | None) -> Any:
        return SimpleNamespace(
            walls=[SimpleNamespace(frame=SimpleNamespace(map_crs=name)) for name in names]
        )

    assert module.common_crs_wkt(None) == ""
    assert module.common_crs_wkt(walls(None, "site")) == ""
    assert CRS.from_wkt(module.common_crs_wkt(walls("EPSG:25832", None))).to_epsg() == 25832
    assert module.common_crs_wkt(walls("EPSG:25832", "EPSG:25833")) == ""


@pytest.mark.parametrize("colour", [None, "intensity"])
def test_photos_colour_what_they_see_and_the_rest_stays_grey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, colour: str | None
) -> None:
    def colour_points(_cloud: object, given: object, colours: Any) -> None:
        assert given == oriented
        colours.rgb[0], colours.photo[0] = (1, 2, 3), 0

    monkeypatch.setattr("orthoflow.cli.exports.clouds.colour_points", colour_points)
    oriented = ((SimpleNamespace(name="a.jpg"), "its camera"),)
    monkeypatch.setattr(module, "oriented_photos", lambda *_args: oriented)
    said, attributed = exported(tmp_path, labelled(), colour=colour)
    if colour == "intensity":
        assert (attributed.photo_colours, attributed.photo_names) == (None, ())
        return
    assert said == "cloud.toy: 144 points coloured by photos, cloud of plane"
    assert (attributed.colouring, attributed.photo_names) == ("photos", ("a.jpg",))
    colours = attributed.photo_colours
    assert colours is not None
    assert colours.rgb[0].tolist() == [1, 2, 3]
    assert (colours.rgb[1:] == 128).all()
    about = json.loads((tmp_path / "cloud.json").read_text())
    assert about["points_of_the_cloud_by_photo"] == [1]
    assert about["points_of_the_cloud_unseen"] == N_SIDE**2 - 1
    # What was mapped for it is gone.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.json", "cloud.toy"]


def photographed(*names: str, takes: bool = True) -> HeldRun:
    """A run that oriented two photos, and could not orient a third; twice."""
    one = cameras_product().cameras[0]
    refused = Camera(photo="c.jpg", status="too few ties")
    first = Cameras(cameras=(replace(one, photo="a.jpg"), refused))
    last = Cameras(cameras=(replace(one, photo="b.jpg"), replace(one, photo="a.jpg"), refused))
    photos = [Photo(name=name, encoded=b"", width=4, height=3) for name in names]
    taken = {"photos": "shots"} if takes else {}
    return toy_run(
        shots=({}, {"photos": Photos(photos=tuple(photos))}),
        orient=(taken, {"cameras": first}),
        bundle=(taken, {"cameras": last}),
    )


def test_photos_are_those_that_the_last_cell_oriented(tmp_path: Path) -> None:
    chosen = Choices(store=tmp_path)
    run = photographed("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    found = module.oriented_photos(run, run.cells, chosen)
    assert [photo.name for photo, _ in found] == ["a.jpg", "b.jpg"]
    np.testing.assert_allclose(
        found[0][1].centre_world, cameras_product().cameras[0].viewing().centre_world
    )
    first = {name: cell for name, cell in run.cells.items() if name != "bundle"}
    assert [photo.name for photo, _ in module.oriented_photos(run, first, chosen)] == ["a.jpg"]
    assert module.oriented_photos(run, {"shots": run.cells["shots"]}, chosen) == ()
    alone = photographed("a.jpg", takes=False)
    assert module.oriented_photos(alone, alone.cells, chosen) == ()
