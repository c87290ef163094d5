"""Cameras of other programs, each against the formula that its program documents."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from orthoflow.errors import InputError
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.cube_faces import FACES, FisheyeLens, PanoramaLens, face_lenses
from orthoflow.files.given_cameras import MAX_LEFT_OUT_PX, NEGLIGIBLE_PX, CentredLens, GivenCamera
from orthoflow.files.publishing import publish_cameras
from orthoflow.products import Camera, Cameras, Intrinsics
from tests import scenes

WIDTH, HEIGHT = 640, 480
POINTS = np.random.default_rng(2).uniform([-1, -1, 3], [1, 1, 6], (20, 3))


def pose(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World from camera (axes x right, y down, z forward): rotation and centre."""
    rng = np.random.default_rng(seed)
    return scenes.random_rotation(rng), rng.uniform(-50.0, 50.0, 3)


def seen_world(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(POINTS @ rotation.T + centre)


def pixels(given: GivenCamera, points_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """What our own camera makes of it."""
    lens = given.lens
    if isinstance(lens, CentredLens):
        lens, _ = lens.of_size(WIDTH, HEIGHT)
    assert isinstance(lens, Intrinsics)
    assert lens.source == "given"
    assert (lens.width, lens.height) == (WIDTH, HEIGHT)
    return lens.posed(given.rotation, given.translation).project(points_world)[:, :2]


def words(values: object) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(np.asarray(values)))


def write(folder: Path, files: dict[str, str | bytes]) -> list[Path]:
    for name, content in files.items():
        data = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(data)
    return [folder / name for name in files]


# COLMAP: models as pycolmap writes them, against its own projection.

PARAMS: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [500, 321, 239],
    "PINHOLE": [500, 505, 321, 239],
    "SIMPLE_RADIAL": [500, 321, 239, -0.05],
    "RADIAL": [500, 321, 239, -0.05, 0.02],
    "OPENCV": [500, 505, 321, 239, -0.05, 0.02, 1e-3, -2e-3],
    "FULL_OPENCV": [500, 505, 321, 239, -0.05, 0.02, 1e-3, -2e-3, 0.01, 0, 0, 0],
    "SIMPLE_FISHEYE": [300, 321, 239],
    "FISHEYE": [300, 305, 321, 239],
    "SIMPLE_RADIAL_FISHEYE": [300, 321, 239, -0.05],
    "RADIAL_FISHEYE": [300, 321, 239, -0.05, 0.02],
    "OPENCV_FISHEYE": [300, 305, 321, 239, -0.05, 0.02, 1e-3, -2e-3],
}
# Which OpenCV's lenses hold nearly.
NEARLY: dict[str, list[float]] = {
    "FULL_OPENCV": [500, 505, 321, 239, -0.05, 0.02, 1e-3, -2e-3, 0.01, 0.01, 0, 0],
    "FOV": [500, 505, 321, 239, 0.3],
    "SIMPLE_DIVISION": [500, 321, 239, -0.05],
    "DIVISION": [500, 505, 321, 239, -0.02],
    "EUCM": [500, 505, 321, 239, 0.2, 1.1],
    "THIN_PRISM_FISHEYE": [300, 305, 321, 239, -0.02, 0.01, 1e-4, 2e-4, 0, 0, 1e-5, 1e-5],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(300, 305, 321, 239, -0.02, 0.01, 0, 0, 0, 0, 1e-4, 2e-4, 1e-5, 0, 1e-5, 0)
    ],
}


def colmap_model(
    folder: Path, model: str, params: list[float], form: str, *, has_rigs: bool = True
) -> tuple[list[Path], pycolmap.Reconstruction]:
    """Two photos of one camera as COLMAP has them, in a folder as it makes it."""
    written = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=7, model=model, width=WIDTH, height=HEIGHT, params=params)
    written.add_camera_with_trivial_rig(camera)
    for number, name in ((1, "b.jpg"), (2, "walls/north face/a.jpg")):
        rotation, centre = pose(number)
        image = pycolmap.Image(name=name, camera_id=7, image_id=number)
        seen = pycolmap.Rigid3d(np.column_stack([rotation.T, -rotation.T @ centre]))
        written.add_image_with_trivial_frame(image, seen)
    model_folder = folder / "sparse" / "0"
    model_folder.mkdir(parents=True)
    (written.write_text if form == "txt" else written.write_binary)(str(model_folder))
    if not has_rigs:
        for part in ("rigs", "frames"):
            (model_folder / f"{part}.{form}").unlink()
    return sorted(path for path in folder.rglob("*") if path.is_file()), written


def projected(given: GivenCamera) -> NDArray[np.float64]:
    """Pixels of `POINTS` before a camera, by our lens."""
    lens = given.lens
    assert isinstance(lens, Intrinsics | FisheyeLens), given.reason
    viewing = lens if isinstance(lens, FisheyeLens) else lens.posed()
    return viewing.project(POINTS)[:, :2]


@pytest.mark.parametrize(("form", "has_rigs"), [("txt", True), ("bin", False)])
@pytest.mark.parametrize("model", PARAMS)
def test_colmap_models_project_as_colmap_does(
    tmp_path: Path, model: str, form: str, has_rigs: bool
) -> None:
    paths, written = colmap_model(tmp_path, model, PARAMS[model], form, has_rigs=has_rigs)
    found = read_given_cameras(paths)
    assert [given.name for given in found] == ["b.jpg", "walls/north face/a.jpg"]
    for number, given in enumerate(found, start=1):
        assert given.note == ""
        theirs = written.camera(7).img_from_cam(POINTS)
        np.testing.assert_allclose(projected(given), theirs, atol=1e-8)
        rotation, centre = pose(number)
        np.testing.assert_allclose(given.rotation, rotation.T, atol=1e-12)
        np.testing.assert_allclose(given.translation, -rotation.T @ centre, atol=1e-9)


@pytest.mark.parametrize("model", NEARLY)
def test_models_that_opencv_lacks_are_taken_as_its_nearest_with_their_deviation(
    tmp_path: Path, model: str
) -> None:
    paths, written = colmap_model(tmp_path, model, NEARLY[model], "bin")
    (given, _) = read_given_cameras(paths)
    off_px = np.linalg.norm(projected(given) - written.camera(7).img_from_cam(POINTS), axis=1)
    assert off_px.max() < MAX_LEFT_OUT_PX
    assert bool(given.note) == (off_px.max() > NEGLIGIBLE_PX) or off_px.max() < NEGLIGIBLE_PX


def test_a_model_far_from_opencv_is_refused_with_its_size_in_pixels(tmp_path: Path) -> None:
    params = [300.0, 300, 321, 239, 0, 0, 0, 0, 0, 0, 0.05, 0]
    paths, _ = colmap_model(tmp_path, "THIN_PRISM_FISHEYE", params, "bin")
    (given, _) = read_given_cameras(paths)
    assert given.rotation is None
    assert re.search(r"THIN_PRISM_FISHEYE differs from .* by up to [\d.e+]+ pixels", given.reason)


def test_a_panorama_of_colmap_looks_where_its_front_does(tmp_path: Path) -> None:
    paths, written = colmap_model(tmp_path, "EQUIRECTANGULAR", [WIDTH, HEIGHT], "bin")
    _, given = read_given_cameras(paths)
    assert given.lens == PanoramaLens(width=WIDTH, height=HEIGHT)
    assert isinstance(given.lens, PanoramaLens)
    np.testing.assert_allclose(
        given.lens.project(POINTS), written.camera(7).img_from_cam(POINTS), atol=1e-8
    )
    front = given.of_face("front")
    np.testing.assert_allclose(
        np.column_stack([np.asarray(front.rotation), np.asarray(front.translation)]),
        written.image(2).cam_from_world().matrix(),
        atol=1e-12,
    )


def rigged_model() -> pycolmap.Reconstruction:
    """Two frames of three cameras."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 3, 2
    options.num_points3D = 20
    return pycolmap.synthesize_dataset(options)


def test_rigs_of_colmap_give_each_camera_its_own_pose(tmp_path: Path) -> None:
    written = rigged_model()
    for form, write_model in (("bin", written.write_binary), ("txt", written.write_text)):
        folder = tmp_path / form
        folder.mkdir()
        write_model(str(folder))
        found = {given.name: given for given in read_given_cameras(sorted(folder.iterdir()))}
        assert len(found) == 6
        for image in written.images.values():
            theirs = image.cam_from_world().matrix()
            np.testing.assert_allclose(found[image.name].rotation, theirs[:, :3], atol=1e-9)
            np.testing.assert_allclose(found[image.name].translation, theirs[:, 3], atol=1e-9)


def test_of_several_reconstructions_the_one_with_most_photos_counts(tmp_path: Path) -> None:
    first, _ = colmap_model(tmp_path, "PINHOLE", PARAMS["PINHOLE"], "bin")
    shutil.copytree(first[0].parent, tmp_path / "sparse" / "2")
    (tmp_path / "sparse" / "1").mkdir()
    rigged_model().write_binary(str(tmp_path / "sparse" / "1"))
    assert len(read_given_cameras(sorted(tmp_path.rglob("*.bin")))) == 6


def oriented(name: str, seed: int) -> Camera:
    rotation, centre = pose(seed)
    lens = Intrinsics(width=WIDTH, height=HEIGHT, fx=500.0, fy=503.0, cx=321.0, cy=239.0)
    return Camera(
        photo=name,
        status="ok",
        intrinsics=replace(lens, distortion=(-0.05, 0.02, 1e-3, -2e-3, 0.01)),
        rotation_camera_from_world=rotation.T,
        translation_camera_from_world=-rotation.T @ centre,
        sigma_wall_m=0.0021,
    )


def test_the_cameras_of_a_run_come_back(tmp_path: Path) -> None:
    camera = oriented("a.jpg", 5)
    lost = Camera(photo="b.jpg", status="no wall is recognised in it")
    publish_cameras(Cameras(cameras=(camera, lost)), tmp_path, "sha256:0")
    given, without = read_given_cameras([tmp_path / "cameras.json"])
    points = seen_world(*pose(5))
    np.testing.assert_allclose(
        pixels(given, points), camera.viewing().project(points)[:, :2], atol=1e-9
    )
    assert given.sigma_wall_m == pytest.approx(0.0021)
    assert (without.name, without.reason) == ("b.jpg", "no wall is recognised in it")


# Bundler: P = R X + t; p = -P / P.z; r(p) = 1 + k1 |p|^2 + k2 |p|^4; p' = f r(p) p, y upwards.


def test_bundler_cameras_project_as_its_manual_says(tmp_path: Path) -> None:
    rotation, centre = pose(3)
    opengl = rotation @ np.diag([1.0, -1.0, -1.0])
    bundler_rotation, bundler_shift = opengl.T, -opengl.T @ centre
    focal, k1, k2 = 500.0, -0.05, 0.02
    text = (
        "# Bundle file v0.3\n2 1\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n"
        f"{focal} {k1} {k2}\n"
        + "".join(f"{words(row)}\n" for row in (*bundler_rotation, bundler_shift))
        + "1 2 3\n255 255 255\n0\n"
    )
    files = {"bundle.out": text, "list.txt": "photos/a.jpg 0 500\nC:\\photos\\b.jpg\n"}
    lost, given = read_given_cameras(write(tmp_path, files))
    assert (lost.name, lost.reason) == ("photos/a.jpg", "Bundler did not orient it")
    assert given.name == "C:/photos/b.jpg"
    points_world = seen_world(rotation, centre)
    camera = points_world @ bundler_rotation.T + bundler_shift
    p = -camera[:, :2] / camera[:, 2:]
    r2 = (p**2).sum(axis=1, keepdims=True)
    scaled = focal * (1 + k1 * r2 + k2 * r2**2) * p
    expected = np.column_stack([WIDTH / 2 + scaled[:, 0], HEIGHT / 2 - scaled[:, 1]])
    np.testing.assert_allclose(pixels(given, points_world), expected, atol=1e-9)


# RealityCapture: the camera looks straight down with north up at heading, pitch and roll 0.


@pytest.mark.parametrize(
    ("angles", "forward", "up"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),
        ((-30, 90, 0), (-0.5, math.sqrt(0.75), 0), (0, 0, 1)),
        ((0, 60, 0), (0, math.sqrt(0.75), -0.5), (0, 0.5, math.sqrt(0.75))),
        # Rolled about what points up in the photo, before it is pitched and headed.
        ((0, 0, 90), (-1, 0, 0), (0, 1, 0)),
        ((90, 90, 30), (math.sqrt(0.75), 0.5, 0), (0, 0, 1)),
    ],
)
def test_realitycapture_angles_are_those_of_a_compass(
    tmp_path: Path,
    angles: tuple[float, float, float],
    forward: tuple[float, float, float],
    up: tuple[float, float, float],
) -> None:
    head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    row = f"a.jpg,10,20,30,{','.join(map(str, angles))},24,0.01,-0.02,-0.05,0.02,0.01,0,0,0\n"
    (given,) = read_given_cameras(write(tmp_path, {"cameras.csv": head + row}))
    assert given.rotation is not None
    assert given.translation is not None
    np.testing.assert_allclose(given.rotation[2], forward, atol=1e-12)
    np.testing.assert_allclose(-given.rotation[1], up, atol=1e-12)
    np.testing.assert_allclose(-given.rotation.T @ given.translation, [10, 20, 30], atol=1e-9)
    assert isinstance(given.lens, CentredLens)
    lens, left_out_px = given.lens.of_size(HEIGHT, WIDTH)  # upright: the longer side counts
    assert left_out_px == 0.0
    assert isinstance(lens, Intrinsics)
    assert lens.fx == pytest.approx(24 / 36 * 640)
    assert (lens.cx, lens.cy) == pytest.approx((240 + 6.4, 320 - 12.8))
    assert lens.distortion == (-0.05, 0.02, 0.0, 0.0, 0.01)


# Files that make no sense.


TURN = "R_camera_from_world"


def json_with(key: str, value: object) -> dict[str, str | bytes]:
    """A cameras.json with another value, or without it."""
    entry: dict[str, object] = {
        "status": "ok",
        "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
        "distortion": [0, 0, 0, 0, 0],
        "width": WIDTH,
        "height": HEIGHT,
        TURN: np.eye(3).tolist(),
        "t_camera_from_world": [0, 0, 0],
        key: value,
    }
    if value is None:
        del entry[key]
    content = json.dumps({"cameras": {"a.jpg": entry}}).replace("Infinity", "1e309")
    return {"c.json": content}


HEAD = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
CAMERA = f"1 PINHOLE {WIDTH} {HEIGHT} 500 500 320 240\n"


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ("1 1 0 0 0 0 0 0 2 a.jpg\n\n", "cannot read the C"),
        ("1 0 0 0 0 0 0 0 1 a.jpg\n\n", "a.jpg"),
        ("# none\n", "the model has no images"),
        (b"1 1 0 0 0 0 0 0 1 \xab.jpg\n\n", "is not UTF-8"),
    ],
)
def test_colmap_models_that_make_no_sense_are_refused(
    tmp_path: Path, images: str | bytes, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_given_cameras(write(tmp_path, {"cameras.txt": CAMERA, "images.txt": images}))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["images", "rigs", "frames"])
@pytest.mark.parametrize("is_first", [True, False])
def test_binary_models_that_state_more_than_they_hold_are_refused(
    tmp_path: Path, part: str, is_first: bool
) -> None:
    paths, _ = colmap_model(tmp_path, "PINHOLE", PARAMS["PINHOLE"], "bin")
    damaged = next(path for path in paths if path.stem == part)
    content = bytearray(damaged.read_bytes())
    # Of all, then those of the first: sensors, data; an image ends within its pose.
    if is_first:
        content[:4] = bytes([255] * 4)
    elif part == "images":
        del content[60:]
    else:
        at = {"rigs": 12, "frames": 72}[part]
        content[at : at + 4] = bytes([255] * 4)
    damaged.write_bytes(content)
    with pytest.raises(InputError, match=f"{part}.bin: it is truncated"):
        read_given_cameras(paths)


@pytest.mark.parametrize("turned", [1e-5, 1e-3])
def test_rounded_rotations_are_made_right_and_others_refused(tmp_path: Path, turned: float) -> None:
    rotation = np.eye(3)
    rotation[0, 1] = 2.0 * turned
    paths = write(tmp_path, json_with(TURN, rotation.tolist()))
    if turned > 1e-4:
        with pytest.raises(InputError, match="not a rotation matrix"):
            read_given_cameras(paths)
        return
    (given,) = read_given_cameras(paths)
    assert given.rotation is not None
    np.testing.assert_allclose(given.rotation @ given.rotation.T, np.eye(3), atol=1e-15)
    # The nearest rotation shares the shear between both axes.
    assert given.rotation[0, 1] == pytest.approx(turned, rel=1e-6)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"list.txt": "my photo 1.jpg 0 500.5\nmy photo 2.jpg"}, "my photo 1.jpg my photo 2.jpg"),
        ({"list.txt": "'a b.jpg'\n\"c d.jpg\"\n", "other.txt": "c"}, "a b.jpg c d.jpg"),
        ({"list.txt": "x.jpg", "photos.txt": "a.jpg\nb.jpg"}, "a.jpg b.jpg"),
        ({"list.txt": "a.jpg\nb.jpg", "list_old.txt": "c.jpg\nd.jpg"}, "a.jpg b.jpg"),
        ({"list_1.txt": "a.jpg\nb.jpg", "list_2.txt": "a.jpg 0 9\nb.jpg"}, "a.jpg b.jpg"),
        ({"a_list.txt": "a.jpg\nb.jpg", "list_keys.txt": "a.key\nb.key"}, "a.jpg b.jpg"),
        ({"LIST.txt": "c.jpg\nd.jpg", "bundle.out.list.txt": "a.tif\nb.tif"}, "a.tif b.tif"),
        ({"list.txt": "a.jpg\nb.jpg", "bundle_001.out": "1 0\n"}, "a.jpg b.jpg"),
    ],
)
def test_the_list_of_bundler_is_the_one_with_as_many_names(
    tmp_path: Path, files: dict[str, str | bytes], expected: str
) -> None:
    bundle = "2 0\n" + "0 0 0\n" * 10
    found = read_given_cameras(write(tmp_path, {"bundle.out": bundle, **files}))
    assert " ".join(given.name for given in found) == expected


@pytest.mark.parametrize(
    "text",
    [
        "#cameras 1\n#name,x,y,alt,heading,pitch,roll,f\na.jpg,1,2,3,0,0,0,24\n",
        "# written today\n\nname;x;y;alt;heading;pitch;roll;f\n# a comment\na.jpg;1;2;3;0;0;0;24\n",
        "#name,x,y,alt,roll,pitch,heading,f,note\na.jpg,1,2,3,0,0,0,24,good\n",
        "\ufeff#Name\tX\tY\tZ\tHeading\tPitch\tRoll\tF\r\na.jpg\t1\t2\t3\t0\t0\t0\t24\r\n",
    ],
    ids=["few-columns", "semicolons", "other-order", "capitals"],
)
def test_columns_of_realitycapture_may_be_missing_and_lines_be_comments(
    tmp_path: Path, text: str
) -> None:
    files: dict[str, str | bytes] = {"export.txt": text, "notes.txt": "of the photos\n"}
    (given,) = read_given_cameras(write(tmp_path, files))
    assert isinstance(given.lens, CentredLens)
    assert given.lens.of_size(WIDTH, HEIGHT)[0].fx == pytest.approx(24 / 36 * WIDTH)
    np.testing.assert_allclose(given.translation, [-1, 2, 3], atol=1e-12)


def test_tangential_terms_of_unknown_order_are_left_out_with_their_size() -> None:
    lens = CentredLens(focal_px=500.0, radial=(0.0, 0.0, 0.0), tangential=(1e-3, 0.0))
    # f t 3 r^2 in the corner.
    expected_px = 500 * 1e-3 * 3 * (320**2 + 240**2) / 500**2
    assert lens.of_size(WIDTH, HEIGHT)[1] == pytest.approx(expected_px)


def test_the_faces_of_a_fisheye_have_its_place_and_their_own_directions(tmp_path: Path) -> None:
    rotation, centre = pose(1)
    paths, _ = colmap_model(tmp_path, "OPENCV_FISHEYE", PARAMS["OPENCV_FISHEYE"], "bin")
    (given, _) = read_given_cameras(paths)
    assert isinstance(given.lens, FisheyeLens)
    places = np.array([[1.5, 2.5], [20.5, 9.5]])
    for face in face_lenses(given.lens):
        camera = given.of_face(face)
        assert isinstance(camera.lens, Intrinsics)
        viewing = camera.lens.posed(camera.rotation, camera.translation)
        np.testing.assert_allclose(viewing.centre_world, centre, atol=1e-9)
        # Through the axes of the fisheye on the one hand, through the world on the other.
        own = camera.lens.posed().rays_world(places) @ FACES[face]
        np.testing.assert_allclose(viewing.rays_world(places) @ rotation, own, atol=1e-9)
    assert given.of_face("back").reason == "its lens does not cover that face"
    folding = replace(given, lens=replace(given.lens, radial=(-0.9, 0.0, 0.0, 0.0)))
    assert folding.of_face("front").reason.startswith("its lens is invalid: its distortion")
    # What has no orientation has none on any face, and keeps its reason.
    lost = replace(given, rotation=None, translation=None, reason="too few ties")
    assert lost.of_face("front") is lost
