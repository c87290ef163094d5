"""What an export of Metashape leaves out, or says twice, and what becomes of it.

That cameras project as Metashape's manual says stands in test_given_cameras.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.fisheyes import FisheyeLens
from orthoflow.files.given_cameras import GivenCamera
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


def read(folder: Path, text: str) -> tuple[GivenCamera, ...]:
    path = folder / "cameras.xml"
    path.write_text(text, encoding="utf-8")
    return read_metashape_xml(path)


def lens_of(folder: Path, sensor: str) -> Intrinsics:
    (given,) = read(folder, document(sensors=sensor))
    assert isinstance(given.lens, Intrinsics)
    return given.lens


def test_a_lens_of_a_focal_length_alone_looks_through_the_middle_without_distortion(
    tmp_path: Path,
) -> None:
    lens = lens_of(tmp_path, SENSOR)
    assert lens == Intrinsics(
        width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0, source="given"
    )


def test_a_calibration_has_the_size_it_says_else_that_of_its_sensor(tmp_path: Path) -> None:
    own = ADJUSTED.replace("<f>", '<resolution width="320" height="200"/><f>')
    sensor = SENSOR.replace(ADJUSTED, own)
    lens = lens_of(tmp_path, sensor)
    assert (lens.width, lens.height, lens.cx, lens.cy) == (320, 200, 160.0, 100.0)
    without = lens_of(tmp_path, sensor.replace(SIZE, ""))
    assert without == lens


@pytest.mark.parametrize(
    ("calibrations", "focal_px"),
    [
        ([("initial", 400)], 400.0),
        ([("adjusted", 500), ("initial", 400)], 500.0),
        ([("initial", 400), ("adjusted", 500), ("adjusted", 501)], 501.0),
        ([("initial", 400), ("initial", 401)], 401.0),
    ],
    ids=["nothing-adjusted", "adjusted-first", "the-last-adjusted", "the-last"],
)
def test_the_last_calibration_holds_an_adjusted_one_before_others(
    tmp_path: Path, calibrations: list[tuple[str, int]], focal_px: float
) -> None:
    texts = [f'<calibration class="{kind}"><f>{f}</f></calibration>' for kind, f in calibrations]
    assert lens_of(tmp_path, SENSOR.replace(ADJUSTED, "".join(texts))).fx == focal_px


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        (SENSOR.replace(ADJUSTED, ""), "its sensor NIKON has no calibration"),
        (SENSOR.replace("<f>500</f>", "<k1>0</k1>"), "has no focal length f (Metashape 1.2 or"),
        (SENSOR.replace('"frame"', '"rpc"', 1), "orthoflow takes frame, fisheye and spherical"),
        (
            SENSOR.replace('"frame"', '"fisheye"', 1).replace("</f>", "</f><p3>1e-3</p3>"),
            "its sensor NIKON has p3, which OpenCV's model has not",
        ),
        (SENSOR.replace(' label="NIKON"', "").replace(ADJUSTED, ""), "its sensor 0 has no calib"),
        ("", "it names no sensor"),
    ],
    ids=[
        "no-calibration",
        "no-focal-length",
        "satellite",
        "fisheye-terms",
        "no-label",
        "no-sensor",
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
    assert given.lens == FisheyeLens(
        width=640,
        height=480,
        fx=501.0,
        fy=500.0,
        cx=323.0,
        cy=238.0,
        radial=(0.04, 0.03, 0.02, 0.01),
        tangential=(2e-3, 1e-3),
        skew=0.5,
    )
    assert given.rotation is not None


def test_a_sensor_without_a_type_is_a_frame(tmp_path: Path) -> None:
    assert lens_of(tmp_path, SENSOR.replace(' type="frame"', "", 1)).fx == 500.0


def test_a_panorama_that_was_not_aligned_is_one_camera_with_its_reason(tmp_path: Path) -> None:
    sensor = f'<sensor id="0" label="360" type="spherical">{SIZE}</sensor>'
    (given,) = read(
        tmp_path, document(sensors=sensor, cameras='<camera sensor_id="0" label="r.jpg"/>')
    )
    assert (given.name, given.reason) == ("r.jpg", "Metashape did not align it")


def test_a_component_leads_to_the_world_before_the_chunk_does(tmp_path: Path) -> None:
    def moved(x: float) -> str:
        return f"<transform><translation>{x} 0 0</translation></transform>"

    parts = f'<components><component id="7">{moved(5)}</component></components>{moved(-3)}'
    cameras = CAMERA.replace("<camera ", '<camera component_id="7" ') + CAMERA.replace(
        "a.jpg", "b.jpg"
    )
    inside, outside = read(tmp_path, document(chunk=parts, cameras=cameras))
    # A camera that stands at x looks back at the origin from there.
    assert inside.translation is not None
    assert outside.translation is not None
    np.testing.assert_allclose(inside.translation, [-5.0, 0.0, 0.0])
    np.testing.assert_allclose(outside.translation, [3.0, 0.0, 0.0])


def test_cameras_of_all_chunks_are_read_wherever_the_chunks_stand(tmp_path: Path) -> None:
    second = document(cameras=CAMERA.replace("a.jpg", "b.jpg")).removeprefix("<document>")
    both = document().removesuffix("</document>") + second
    assert [given.name for given in read(tmp_path, both)] == ["a.jpg", "b.jpg"]
    nested = both.replace("<document>", "<document><chunks>").replace(
        "</document>", "</chunks></document>"
    )
    assert [given.name for given in read(tmp_path, nested)] == ["a.jpg", "b.jpg"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            document(chunk="<transform><rotation>1 0 0</rotation></transform>"),
            "the rotation of the chunk must be 9 numbers, got 3",
        ),
        (
            document(chunk="<transform><translation>1 0</translation></transform>"),
            "the translation of the chunk must be 3 numbers, got 2",
        ),
        (
            document(chunk="<transform><scale>1 2</scale></transform>"),
            "the scale of the chunk must be 1 numbers, got 2",
        ),
        (
            document(chunk="<transform><scale>-2</scale></transform>"),
            "the scale of the chunk must be positive, got -2",
        ),
        (document(sensors=SENSOR.replace(SIZE, "")), "NIKON does not say how many pixels it has"),
        (
            document(sensors=SENSOR.replace('height="480"', 'height="0"')),
            "NIKON does not say how many pixels it has",
        ),
        ('<!ENTITY a "b">' + document(), "defines a document type"),
        (document(cameras=""), "holds no cameras of Metashape"),
    ],
)
def test_what_contradicts_itself_ends_in_one_sentence(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_sensor_of_one_pixel_is_a_sensor(tmp_path: Path) -> None:
    lens = lens_of(tmp_path, SENSOR.replace("640", "1").replace("480", "1"))
    assert (lens.width, lens.height) == (1, 1)
