"""Files of people and of other programs with mistakes: what is printed for each, as a snapshot.

The snapshot holds file, line and sentence. Review it as text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.errors import InputError
from orthoflow.files.calibration import read_calibration
from orthoflow.files.camera_formats import read_given_cameras
from orthoflow.files.drawings.sheet_contents import read_title_block
from orthoflow.files.metashape import read_metashape_xml
from orthoflow.files.polygons import read_polygons
from orthoflow.files.sidecars import read_sidecar
from orthoflow.files.survey_points import read_measured_ties, read_survey_points
from tests.files import test_metashape as agisoft
from tests.files.test_calibration import GOOD
from tests.files.test_given_cameras import HEAD, TURN, json_with
from tests.files.test_vector_files import SQUARE, feature, features

ALL = "name,x,y,z,wall,u_px,v_px\n"
BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]><x>&b;</x>'
NOT_FINITE = np.diag([1.0, 1, 1, np.nan])


def camera(change: str) -> str:
    return f"cameras: {{'*': {{{change}}}}}"


def transformed(matrix: str) -> str:
    return agisoft.document(chunk=f"<transform>{matrix}</transform>")


Content = str | bytes
# Name -> reader, name of the file, and its contents.
FILES: Mapping[str, tuple[Callable[[Path], object], str, Sequence[Content]]] = {
    "calibration": (read_calibration, "calibration.yaml", (
        *("", "- 1\n", "cameras: {}\n", "cameras:\n  a.jpg: {width: 10}\n"),
        "cameras:\n  a.jpg:\n    heigth: 5\n",
        "cameras:\n  a.jpg: {width: 4000, height: 3000, fx: 3000,5, fy: 3000}\n",
        "cameras:\n  a.jpg: {fx: .nan}\n",
        camera(f"{GOOD}, distortion: [0.1, 0, 0, 0]"),
        camera(f"field_of_view_deg: 90, {GOOD}"),
        camera(f"model: fisheye, field_of_view_deg: 400, {GOOD}"),
        camera(f"model: fisheye, {GOOD}, distortion: [-0.8, 0, 0, 0]"),
        camera(GOOD.replace("fx: 3000", "fx: 28")),
        camera(GOOD.replace("cx: 1999.5", "cx: 19995")),
        "cameras:\n  a.jpg: {width: x}\n  b.jpg:\n    fx: y\n    cz: 1\nother: 1\n",
    )),
    "check points": (read_survey_points, "p.csv", (
        *("", "name,x,y,z\n", "name,x,y,zz\nP,1,2,3", "name,y\nP,1", "name,x,y,z,x\nP,1,2,3,4"),
        *("name,x,y,z,v_px,u_px\nP,1,2,3,4,5", "P,1,2\n", "name,x,y,z\nP,1,5,2,5\n"),
        *("name;x;y;z\nP;1,5;2;c,d\n", "name,x,y,z\nP,1,,3\n", "name,x,y,z\nP,1,nan,3\n"),
        *("name,x,y,z\nP,1_0,2,3\n", "name,x,y,z\n,1,2,3\n", "P,1,2,3\n\nP,4,5,6\n#\nP,7,8,9"),
        f"{ALL}P,1,2,3,0,5,\n",
        *(f"{ALL}P,1,2,3,{wall},5,6\n" for wall in ("0.5", "-1", "32001")),
        *("P,1,2,3\n" + "x" * 10_001, b"P,1,2,\xff\n", "name,x,y,z,map_x\nP,1,2,3,4\n"),
        "name,x,y,z,wall,u_px,v_px,map_x,map_y\nP,1,2,3,0,1,2,4,5\n",
        "name,x,y,z,shown_x,shown_y,shown_z\nP,1,2,3,4,,6\n",
        *("name,x,y,z\n" + "".join(f"P{k},1,x,3\n" for k in range(n)) for n in (20, 21)),
    )),
    "ties": (read_measured_ties, "t.csv", (
        "photo,u_px,v_px,x,y,z,sigma_px\na.jpg,1,2,3,4,5,-1\n,1,2,3,4,5,1\n",
        "photo,u_px,v_px,x,y,z\na.jpg,1,2,3,4\n",
        *("photo,u,v,x,y,z\n", "a.jpg,1,2,3\n", ""),
    )),
    "sidecar": (read_sidecar, "a.json", (b"\xff", "{", "[]")),
    "masks": (lambda path: read_polygons(path, "photo", what="a mask"), "masks.json", (
        *("{", '{"features": 3}', '{"features": [7]}'),
        *(features(feature([SQUARE]), one) for one in (
            *(feature([SQUARE], photo=5), feature([SQUARE[:2]]), feature([])),
            *(feature([[[0.0, 0.0], [1e9, 0.0], [4.0, 3.0]]]), feature([SQUARE], kind="Point")),
            {"type": "Feature", "properties": {}, "geometry": None},
        )),
        features(feature([SQUARE])).replace("4.0", "1" + 400 * "0"),
    )),
    "title block": (read_title_block, "block.yaml", (
        *("projct: a\n", "title: [1]\n", f"note: {'a' * 301}\n", "layout: middle\n", "a" * 100_001),
        "revisions: [{mark: A, texts: b}]\n",
        *("logo: none.png\n", "logo: block.yaml\n"),
    )),
    "metashape": (read_metashape_xml, "cameras.xml", (
        *(BOMB, BOMB.encode("utf-16"), "<document><chunk>", "<document/>"),
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><x>&a;</x>',
        *map(agisoft.posed_by, (np.eye(4)[:3], 2.0 * np.eye(4), NOT_FINITE)),
        *(agisoft.document().replace("<f>500</f>", f"<f>{f}</f>") for f in ("-1", "5 px")),
        transformed("<rotation>1 0 0</rotation>"),
        transformed("<scale>-2</scale>"),
        agisoft.document(sensors=agisoft.SENSOR.replace(agisoft.SIZE, "")),
    )),
}  # fmt: skip
BUNDLE_LIST = {"list.txt": "a.jpg\n"}
CAMERAS: Sequence[Mapping[str, Content]] = (
    *({"a.jpg": ""}, {f"{n}.jpg": "" for n in "abcd"}, {"c.json": "[1"}, json_with("K", None)),
    *(json_with("distortion", [0]), json_with(TURN, [[1] * 3] * 3), json_with("width", 0)),
    *(json_with("width", 10**30), json_with("K", [[1, 0, 0], [0, -2, 0], [0, 0, 1]])),
    *(json_with("distortion", [0, 0, 0, 0, "1e999"]), json_with("sigma_wall_mm", [1])),
    # A mirror is no turn; and LAPACK never ended with an infinity.
    json_with(TURN, [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    json_with(TURN, [[1, 0, 0], [float("inf"), 1, 0], [0, 0, 1]]),
    {"b.out": "1 0\n", "list.txt": "a.jpg\nb.jpg\n"},
    *({"b.out": text} | BUNDLE_LIST for text in ("1 0\n500 0 0\n", "# Bundle\n")),
    *({"b.out": "1 0\n"}, {"b.out": "1 0\n", "l.txt": "a.jpg", "m.txt": "b.jpg"}),
    *({"c.csv": HEAD + "a.jpg,1,2,3,0,0,0,0,0,0,0,0,0,0,0,0\n"}, {"c.csv": "name,heading,x,y,z\n"}),
    {"c.csv": HEAD + "a.jpg,1,2,3,0,0,0,24,0,zero,0,0,0,0,0,0\n"},
    *({"c.csv": HEAD + "x" * 200_000 + ",1\n"}, {"c.xml": "<" * 2_000_001}),
)


def refused(read: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        read()
    return str(caught.value)


@pytest.mark.parametrize("kind", FILES)
def test_what_is_printed_for_a_file_with_mistakes(
    kind: str, tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    read, name, contents = FILES[kind]
    messages = []
    for content in contents:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        messages.append(refused(lambda path=path: read(path)).splitlines())
    assert messages == snapshot


def test_what_is_printed_for_files_of_cameras_with_mistakes(
    tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    messages = []
    for number, files in enumerate(CAMERAS):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_text(str(content))
        messages.append(refused(lambda folder=folder: read_given_cameras(sorted(folder.iterdir()))))
    assert messages == snapshot
    assert not any("\n" in message for message in messages)
