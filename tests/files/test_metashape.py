"""What an export of Metashape leaves out, or says twice, and what becomes of it."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import pyproj
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from orthoflow.errors import InputError
from orthoflow.files.cube_faces import FisheyeLens, PanoramaLens
from orthoflow.files.given_cameras import MAX_LEFT_OUT_PX, GivenCamera
from orthoflow.files.metashape import read_metashape_xml
from orthoflow.products import Intrinsics

SIZE = '<resolution width="640" height="480"/>'
ADJUSTED = '<calibration type="frame" class="adjusted"><f>500</f></calibration>'
SENSOR = f'<sensor id="0" label="NIKON" type="frame">{SIZE}{ADJUSTED}</sensor>'
POSE = f"<transform>{' '.join(map(str, np.eye(4).ravel()))}</transform>"
CAMERA = f'<camera id="0" sensor_id="0" label="a.jpg">{POSE}</camera>'


def document(*, sensors: str = SENSOR, cameras: str = CAMERA, chunk: str = "") -> str:
    return (
        f"<document><chunk><sensors>{sensors}</sensors>{chunk}"
        f"<cameras>{cameras}</cameras></chunk></document>"
    )


def read(folder: Path, text: str | bytes) -> tuple[GivenCamera, ...]:
    path = folder / "cameras.xml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_metashape_xml(path)


def test_the_last_calibration_holds_an_adjusted_one_before_others(tmp_path: Path) -> None:
    for said, focal_px in (
        ("initial 400", 400.0),
        ("adjusted 500, initial 400", 500.0),
        ("initial 400, adjusted 500, adjusted 501", 501.0),
    ):
        texts = [
            f'<calibration class="{kind}"><f>{f}</f></calibration>'
            for kind, f in (one.split() for one in said.split(", "))
        ]
        (given,) = read(tmp_path, document(sensors=SENSOR.replace(ADJUSTED, "".join(texts))))
        assert isinstance(given.lens, Intrinsics)
        assert given.lens.fx == focal_px


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        (SENSOR.replace(ADJUSTED, ""), "its sensor NIKON has no calibration"),
        (SENSOR.replace("<f>500</f>", "<k1>0</k1>"), "has no focal length f (Metashape 1.2 or"),
        (SENSOR.replace('"frame"', '"rpc"', 1), "orthoflow supports frame, fisheye and spherical"),
        (SENSOR.replace(' label="NIKON"', "").replace(ADJUSTED, ""), "its sensor 0 has no calib"),
        ("", "it has no sensor"),
    ],
)
def test_a_camera_without_a_lens_says_why(tmp_path: Path, sensor: str, reason: str) -> None:
    (given,) = read(tmp_path, document(sensors=sensor))
    assert reason in given.reason
    assert given.name == "a.jpg"
    assert (given.lens, given.rotation, given.translation) == (None, None, None)


def test_a_fisheye_sensor_has_all_terms_that_its_formula_has(tmp_path: Path) -> None:
    terms = {"cx": 3, "cy": -2, "b1": 1, "b2": 0.5, "p1": 1e-3, "p2": 2e-3}
    radial = {"k1": 0.04, "k2": 0.03, "k3": 0.02, "k4": 0.01}
    said = "".join(f"<{name}>{value}</{name}>" for name, value in {**terms, **radial}.items())
    sensor = SENSOR.replace('"frame"', '"fisheye"').replace("</f>", f"</f>{said}")
    (given,) = read(tmp_path, document(sensors=sensor))
    lens = FisheyeLens(width=640, height=480, fx=501.0, fy=500.0, cx=323.0, cy=238.0, skew=0.5)
    radial = (0.04, 0.03, 0.02, 0.01)
    assert given.lens == replace(lens, radial=radial, tangential=(2e-3, 1e-3))
    assert given.rotation is not None


def test_cameras_of_all_chunks_are_read_wherever_the_chunks_stand(tmp_path: Path) -> None:
    second = document(cameras=CAMERA.replace("a.jpg", "b.jpg")).removeprefix("<document>")
    both = document().removesuffix("</document>") + second
    assert [given.name for given in read(tmp_path, both)] == ["a.jpg", "b.jpg"]
    nested = both.replace("<document>", "<document><chunks>").replace(
        "</document>", "</chunks></document>"
    )
    assert [given.name for given in read(tmp_path, nested)] == ["a.jpg", "b.jpg"]


def numbers(values: object) -> str:
    return " ".join(map(repr, np.ravel(np.asarray(values, dtype=np.float64)).tolist()))


def posed_by(matrix: object) -> str:
    return document(cameras=CAMERA.replace(POSE, f"<transform>{numbers(matrix)}</transform>"))


# The formulas of the manual, appendix "Camera models".

MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
MATRIX[:3, 3] = [1.0, 2.0, 3.0]
TERMS = {"f": 500.0, "cx": 1.5, "cy": -2.25, "b1": 0.75, "k1": -0.05, "k2": 0.02, "k3": 0.01}
TERMS |= {"p1": 1e-3, "p2": -2e-3}
POINTS = np.random.default_rng(2).uniform([-1, -1, 3], [1, 1, 6], (20, 3))


def sensor_of(terms: Mapping[str, float]) -> str:
    return SENSOR.replace("<f>500</f>", "".join(f"<{k}>{v!r}</{k}>" for k, v in terms.items()))


def formula(points: NDArray[np.float64], terms: Mapping[str, float]) -> NDArray[np.float64]:
    t = defaultdict(float, terms)
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    radial = 1 + r2 * (t["k1"] + r2 * (t["k2"] + r2 * (t["k3"] + r2 * t["k4"])))
    further = 1 + t["p3"] * r2 + t["p4"] * r2 * r2
    u = x * radial + (t["p1"] * (r2 + 2 * x * x) + 2 * t["p2"] * x * y) * further
    v = y * radial + (t["p2"] * (r2 + 2 * y * y) + 2 * t["p1"] * x * y) * further
    return np.column_stack([320 + t["cx"] + u * (t["f"] + t["b1"]), 240 + t["cy"] + v * t["f"]])


def project(given: GivenCamera, points_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixels of points in front of the camera at `MATRIX`."""
    assert isinstance(given.lens, Intrinsics)
    points_world = points_camera @ MATRIX[:3, :3].T + MATRIX[:3, 3]
    return given.lens.posed(given.rotation, given.translation).project(points_world)[:, :2]


@pytest.mark.parametrize("where", ["component", "chunk", "nowhere"])
def test_cameras_project_as_the_manual_says(tmp_path: Path, where: str) -> None:
    turn, shift, scale = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix(), [3.0, -2.0, 5.0], 2.5
    if where == "nowhere":
        turn, shift, scale = np.eye(3), [0.0, 0.0, 0.0], 1.0
    # World = scale * turn * chunk + shift.
    matrix = np.eye(4)
    matrix[:3, :3] = turn.T @ MATRIX[:3, :3]
    matrix[:3, 3] = turn.T @ (MATRIX[:3, 3] - shift) / scale
    transform = (
        f"<transform><rotation>{numbers(turn)}</rotation><translation>{numbers(shift)}"
        f"</translation><scale>{scale}</scale></transform>"
    )
    component = f'<components><component id="0">{transform}</component></components>'
    chunk = {"component": component, "chunk": transform, "nowhere": ""}[where]
    placed = posed("a", matrix, ' component_id="0"')
    cameras = f'<camera id="1" sensor_id="0" label="b.jpg"/><group>{placed}</group>'
    lost, given = read(tmp_path, document(sensors=sensor_of(TERMS), cameras=cameras, chunk=chunk))
    assert (given.name, lost.reason) == ("a", "Metashape did not align it")
    np.testing.assert_allclose(project(given, POINTS), formula(POINTS, TERMS), atol=1e-8)


def test_a_panorama_looks_where_its_camera_does(tmp_path: Path) -> None:
    size = '<resolution width="720" height="360"/>'
    sensor = f'<sensor id="0" label="360" type="spherical">{size}</sensor>'
    (given,) = read(tmp_path, document(sensors=sensor, cameras=posed("r.jpg")))
    assert given.lens == PanoramaLens(width=720, height=360)
    assert given.rotation is not None
    np.testing.assert_allclose(given.rotation, MATRIX[:3, :3].T, atol=1e-12)


@pytest.mark.parametrize(
    "terms",
    [
        {"k1": -0.05, "k2": 0.02, "k3": -0.01, "k4": 0.1},
        {"k1": -0.05, "k2": 0.02, "p1": 1e-3, "p2": -5e-4, "p3": 0.1, "p4": -0.05},
    ],
)
def test_terms_that_opencv_lacks_are_taken_over_by_the_others(
    tmp_path: Path, terms: dict[str, float]
) -> None:
    terms = {"f": 500.0, **terms}
    (given,) = read(tmp_path, document(sensors=sensor_of(terms), cameras=posed("a.jpg")))
    xy = np.random.default_rng(1).uniform([-0.6, -0.45], [0.6, 0.45], (500, 2))
    points = np.column_stack([xy, np.ones(500)])
    assert np.abs(project(given, points) - formula(points, terms)).max() < MAX_LEFT_OUT_PX


def test_terms_of_a_fisheye_that_opencv_lacks_are_taken_over(tmp_path: Path) -> None:
    terms = {"f": 500.0, "k1": 0.03, "p1": 1e-3, "p2": -5e-4, "p3": 0.1, "p4": -0.05}
    sensor = sensor_of(terms).replace('"frame"', '"fisheye"')
    (given,) = read(tmp_path, document(sensors=sensor))
    assert isinstance(given.lens, Intrinsics)
    # As in a frame camera, with the angle off the axis for its tangent.
    xy = np.random.default_rng(1).uniform([-0.6, -0.45], [0.6, 0.45], (50, 2))
    theta = np.hypot(*xy.T)[:, None]
    rays = np.column_stack([xy * np.sin(theta) / theta, np.cos(theta)])
    expected = formula(np.column_stack([xy, np.ones(50)]), terms)
    found = given.lens.posed().project(rays)[:, :2]
    assert np.abs(found - expected).max() < MAX_LEFT_OUT_PX


def test_what_cannot_be_taken_over_is_stated_in_pixels(tmp_path: Path) -> None:
    sensor = SENSOR.replace("</f>", "</f><p1>0.01</p1><p3>20</p3><p4>-60</p4>")
    (given,) = read(tmp_path, document(sensors=sensor))
    assert given.rotation is None
    assert re.search(r"the lens of sensor NIKON differs .* by up to [\d.]+ pixels", given.reason)


# Rigs, disabled cameras, rolling shutters, coordinate systems.


def posed(label: str, matrix: NDArray[np.float64] = MATRIX, more: str = "") -> str:
    head = f'<camera id="{label}" sensor_id="0" label="{label}"{more}>'
    return f"{head}<transform>{numbers(matrix)}</transform></camera>"


@pytest.mark.parametrize("is_chunk", [True, False])
def test_what_is_disabled_is_left_out_with_the_reason(tmp_path: Path, is_chunk: bool) -> None:
    text = document(cameras=posed("a.jpg", more="" if is_chunk else ' enabled="false"'))
    if is_chunk:
        text = text.replace("<chunk>", '<chunk enabled="false">')
    (given,) = read(tmp_path, text)
    assert given.rotation is None
    assert "is disabled in Metashape" in given.reason


def test_cameras_of_a_rig_stand_where_their_sensors_do(tmp_path: Path) -> None:
    turn = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()
    place = [0.1, -0.2, 0.05]
    slave = SENSOR.replace('id="0"', 'id="1" master_id="0"').replace(
        "</sensor>",
        f"<rotation>{numbers(turn)}</rotation><location>{numbers(place)}</location></sensor>",
    )
    cameras = posed("m.jpg") + '<camera id="9" sensor_id="1" master_id="m.jpg" label="s.jpg"/>'
    master, given = read(tmp_path, document(sensors=SENSOR + slave, cameras=cameras))
    assert master.rotation is not None
    assert given.rotation is not None
    np.testing.assert_allclose(given.rotation, turn.T @ master.rotation, atol=1e-12)
    centre = -given.rotation.T @ np.asarray(given.translation)
    np.testing.assert_allclose(centre, MATRIX[:3, :3] @ place + MATRIX[:3, 3], atol=1e-12)


def test_a_rolling_shutter_is_named_with_its_size(tmp_path: Path) -> None:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix()
    shutter = f"<rolling_shutter>{numbers(turned)}</rolling_shutter></camera>"
    camera = posed("a.jpg").replace("</camera>", shutter)
    (given,) = read(tmp_path, document(cameras=camera))
    assert given.rotation is not None
    assert re.search(r"rolling shutter.* by up to 2\.5 pixels", given.note)
    for model, is_named in (("disabled", False), ("regularized", True), ("full", True)):
        sensor = SENSOR.replace("</sensor>", f"<rolling_shutter>{model}</rolling_shutter></sensor>")
        (given,) = read(tmp_path, document(sensors=sensor, cameras=posed("a.jpg")))
        assert ("has a rolling shutter" in given.note) is is_named


UTM = (
    'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["World Geodetic System 1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]],'
    'PROJECTION["Transverse_Mercator"],UNIT["metre",1],AUTHORITY["EPSG","32632"]]'
)


@pytest.mark.parametrize(
    ("epsg", "wkt", "ellipsoid"),
    [(32632, UTM, "WGS84"), (31467, pyproj.CRS.from_epsg(31467).to_wkt("WKT1_GDAL"), "bessel")],
    ids=["WGS 84", "DHDN"],
)
def test_a_georeferenced_chunk_leads_into_its_coordinate_system(
    tmp_path: Path, epsg: int, wkt: str, ellipsoid: str
) -> None:
    # A camera at a place in the zone, level, looking along grid north; three places that it sees.
    place = np.array([3_440_123.4 if epsg == 31467 else 440_123.4, 5_412_345.6, 310.5])
    ahead = np.array([[0.0, 20.0, 0.0], [5.0, 20.0, 1.0], [-5.0, 30.0, -2.0]])
    crs = pyproj.CRS.from_epsg(epsg)
    to_degrees = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform
    to_cartesian = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart +ellps={ellipsoid}"
    ).transform

    def geocentric(x: float, y: float, z: float) -> tuple[float, ...]:
        """Geocentric metres of the system's own datum."""
        return tuple(to_cartesian(*to_degrees(x, y), z))

    centre = np.array(geocentric(*place))
    axes = np.array([np.array(geocentric(*(place + step))) - centre for step in np.eye(3)])
    world_from_grid = np.linalg.qr(axes.T)[0] * np.sign(np.diag(np.linalg.qr(axes.T)[1]))
    grid_from_camera = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    matrix = np.eye(4)
    # The chunk's own transform does a part of it, as Metashape has it.
    chunk = Rotation.from_rotvec([0.4, 0.1, -0.7]).as_matrix()
    matrix[:3, :3] = chunk.T @ world_from_grid @ grid_from_camera
    transform = (
        f"<transform><rotation>{numbers(chunk)}</rotation>"
        f"<translation>{numbers(centre)}</translation><scale>1</scale></transform>"
    )
    text = document(cameras=posed("a.jpg", matrix), chunk=transform)
    text = text.replace("</chunk>", f"<reference>{escape(wkt)}</reference></chunk>")
    (given,) = read(tmp_path, text)
    assert f"from geocentric metres to {crs.name}, heights above its ellipsoid" in given.note
    assert given.rotation is not None
    found = -given.rotation.T @ np.asarray(given.translation)
    np.testing.assert_allclose(found, place, atol=1e-4)
    # Within the scale of the projection.
    seen = (ahead + place - found) @ given.rotation.T
    np.testing.assert_allclose(seen, ahead @ grid_from_camera, atol=30.0 * 5e-4)


@pytest.mark.parametrize(
    ("wkt", "message"),
    [
        (pyproj.CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), "is in degrees"),
        ("PROJCS[nonsense", "its coordinate system is not known"),
        (
            pyproj.CRS.from_user_input("EPSG:25832+5783").to_wkt("WKT1_GDAL"),
            "DHHN92 height, whose heights PROJ cannot compute: set",
        ),
    ],
)
def test_coordinate_systems_that_no_scan_is_in_are_refused(
    tmp_path: Path, wkt: str, message: str
) -> None:
    placed = "<transform><translation>4147216.5 614626.7 4790649.3</translation></transform>"
    text = document(cameras=posed("a.jpg"), chunk=placed)
    text = text.replace("</chunk>", f"<reference>{escape(wkt)}</reference></chunk>")
    with pytest.raises(InputError, match=message):
        read(tmp_path, text)


@pytest.mark.parametrize(
    "wkt",
    [
        'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]',
        # That of a new chunk, which nothing placed in it.
        pyproj.CRS.from_epsg(4326).to_wkt("WKT1_GDAL"),
    ],
)
def test_coordinates_of_a_chunk_alone_are_taken_as_they_are(tmp_path: Path, wkt: str) -> None:
    text = document(cameras=posed("nadir/102MEDIA/0003.jpg"))
    text = text.replace("</chunk>", f"<reference>{escape(wkt)}</reference></chunk>")
    (given,) = read(tmp_path, text)
    assert (given.name, given.note) == ("nadir/102MEDIA/0003.jpg", "")
    np.testing.assert_allclose(given.rotation, MATRIX[:3, :3].T, atol=1e-12)
