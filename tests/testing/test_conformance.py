"""Our own methods pass the conformance suite, through the same door as a stranger's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from tempfile import mkdtemp

import pytest

from orthoflow import testing
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.files.images import encode_jpeg
from orthoflow.files.publishing import publish_cameras
from orthoflow.products import Cameras, InputFiles, Product
from orthoflow.testing import ConformanceCase, conformance_cases
from orthoflow.testing.examples import example
from orthoflow.testing.photographed import settled_camera
from tests import inspect_scenes, ortho_scenes, photo_files, recess_scenes
from tests.undrawn_charts import blank_charts

# Parameters that make a method quick on the suite's small examples; results stay meaningful.
QUICK: dict[str, dict[str, object]] = {
    "simulate.room": {"scan_step_m": 0.1},
    "simulate.curved": {"scan_step_m": 0.1},
    "raster.grid": {"gsd_m": 0.05},
    "match.sift": {"max_features": 1000},
    "match.guided": {"max_ties": 400},
    "orient.colmap-bundle": {"max_features": 1000},
}

# Check that a method cannot pass -> why; the suite says when it starts to pass.
EXPECTED_FAILURES: dict[str, dict[str, str]] = {
    "plane.given": {
        "planes-follow-a-rigid-motion": "it looks for none: its parameters say where the plane is, "
        "else it is the lowest level",
        "stated-errors-of-planes-hold": "what is given has no error of its own",
    },
    "orient.dlt": {
        "poses-are-recovered": "eleven parameters hold no distortion unless `distortion` is set, "
        "and the photos' lens has some"
    },
}

# Recorded results; taking a method out and running the tests records it anew.
GOLDEN = Path(__file__).resolve().parents[1] / "golden.json"
# Method whose results on another processor are not within tolerances of those here -> why.
NO_GOLDEN: dict[str, str] = {
    "match.sift": "which key points OpenCV finds hangs on the instructions that a processor has",
    "match.guided": "which places agree to the last tie hangs on them too",
}

# What a source reads where the suite's own example, a scan, does not fit.
FILES: dict[str, str] = {
    "read.photos": "photo.jpg",
    "read.checkpoints": "points.csv",
    "read.orthoimage": "wall.tif",
    "read.ties": "ties.csv",
    "read.cameras": "cameras.json",
}


def inputs(method_id: str) -> Mapping[str, Product | InputFiles]:
    if method_id in FILES:
        return {"files": example_files(FILES[method_id])}
    if method_id in SCENES:
        return SCENES[method_id]()
    return {}


def example_files(name: str) -> InputFiles:
    contents = {
        "photo.jpg": encode_jpeg(photo_files.picture()),
        "points.csv": b"name,x,y,z\nA,1,2,3\nB,4,5,6\n",
        "wall.tif": inspect_scenes.orthoimage_file(),
        "ties.csv": b"photo,u_px,v_px,x,y,z\na.png,1,2,3,4,5\n",
        "cameras.json": camera_file(),
    }
    folder = Path(mkdtemp(prefix="orthoflow-conformance-"))
    paths = photo_files.write(folder, {name: contents[name]})
    return InputFiles(name="files", paths=paths)


def camera_file() -> bytes:
    folder = Path(mkdtemp(prefix="orthoflow-conformance-"))
    cameras = example("cameras")
    assert isinstance(cameras, Cameras)
    publish_cameras(cameras, folder, "sha256:0")
    return (folder / "cameras.json").read_bytes()


def coloured_wall() -> Mapping[str, Product | InputFiles]:
    """A wall and a board before it as bare points, and a photo of them."""
    where = ortho_scenes.frame()
    oriented = ortho_scenes.cameras(settled_camera(ortho_scenes.camera(where)))
    return {
        "cloud": ortho_scenes.cloud(where, spacing_cells=2.0),
        "photos": ortho_scenes.photos(ortho_scenes.rendered()),
        "cameras": oriented,
    }


# What looks at scenes of its own, known exactly.
SCENES: dict[str, Callable[[], Mapping[str, Product | InputFiles]]] = {
    "inspect.surf": inspect_scenes.surf_inputs,
    "inspect.checkpoints": inspect_scenes.checkpoint_inputs,
    "inspect.truth": inspect_scenes.truth_inputs,
    "inspect.openings": recess_scenes.inputs,
    "register.similarity": inspect_scenes.register_inputs,
    "colour.photos": coloured_wall,
}


def cases() -> list[ConformanceCase]:
    catalog = discover_catalog()
    with pytest.MonkeyPatch.context() as patch:
        # What is installed is read for all methods once.
        patch.setattr(testing.cases, "discover_catalog", lambda: catalog)
        return [
            case
            for method_id, entry in sorted(catalog.methods.items())
            if entry.distribution.name == "orthoflow-tls"
            for case in conformance_cases(
                method_id,
                inputs=partial(inputs, method_id),
                params=QUICK.get(method_id),
                expected_failures=EXPECTED_FAILURES.get(method_id),
                golden=None if method_id in NO_GOLDEN else GOLDEN,
            )
        ]


CASES = cases()
FIRST = {case.method_id: case for case in reversed(CASES)}
# Kinds of which one method is run in a process of its own in every run of the tests: they draw
# random numbers, go through sets or start threads. The long loop runs all methods so.
DRAWING_KINDS = {"plane", "match", "orient", "mosaic", "raster"}
IN_A_NEW_PROCESS = {
    kind: case.method_id
    for case in CASES
    if (kind := case.method_id.partition(".")[0]) in DRAWING_KINDS
}.values()


@pytest.fixture(autouse=True)
def _blank_charts(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Build the charts of detectors and orientations in the first case of each method only."""
    case = request.node.callspec.params["case"]
    if case.method_id.startswith(("plane.", "orient.")) and case is not FIRST[case.method_id]:
        blank_charts(request, monkeypatch)


def is_long(case: ConformanceCase) -> bool:
    """Whether a case takes long: a process of its own for each method, or open3d, which loads."""
    runs_elsewhere = case.check.name in ("nothing-is-written-outside-scratch", "results-repeat")
    return "open3d" in case.method_id or (runs_elsewhere and case.method_id not in IN_A_NEW_PROCESS)


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.long if is_long(case) else ()) for case in CASES],
    ids=str,
)
def test_our_methods_conform(case: ConformanceCase, request: pytest.FixtureRequest) -> None:
    if "open3d" in case.method_id:
        request.getfixturevalue("_open3d")
    case.run()
