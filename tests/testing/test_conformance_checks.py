"""The conformance suite notices every kind of broken rule, and says which."""

from __future__ import annotations

import json
import math
import re
import textwrap
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.store import digest_of
from orthoflow.errors import ArgumentError
from orthoflow.products import Layer, LayerMask, Orthoimages, OrthoMask, Planes
from orthoflow.testing import (
    ConformanceCase,
    ConformanceError,
    Trial,
    TrialRun,
    conformance_cases,
    photographed,
    physics,
    run_trial,
    subjects,
)
from orthoflow.testing.examples import example_room
from tests import samples
from tests.laboratories import write_distribution
from tests.studios import asked

HONEST = """
from __future__ import annotations

import os
import pathlib

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from orthoflow.products import Planes, PointCloud, PointLabels
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


class Floor(Method):
    '''The horizontal plane through the lowest points: a method that keeps every rule.'''

    id = "plane.floor"

    class Params(MethodParams):
        lift_m: float = Field(0.0, description="Raises the plane.")

    class In(Ports):
        cloud: PointCloud

    class Out(Ports):
        planes: Planes
        labels: PointLabels

    def run(self, inputs, params, ctx):
        cloud = inputs.cloud
        self.listen(ctx)
        self.look_at(cloud)
        x, y = (float(np.nanmin(a)) for a in (cloud.x, cloud.y))
        lowest = cloud.z[cloud.z < np.quantile(cloud.z, 0.01) + 0.02]
        z = float(np.median(lowest)) + params.lift_m + self.lift_m(cloud, ctx)
        square = np.array([[x, y + 1, z], [x, y, z], [x + 1, y, z], [x + 1, y + 1, z]])
        planes = Planes(
            normal=np.array([[0.0, 0.0, 1.0]]), offset=np.array([z]) + cloud.origin[2],
            corners=(square + cloud.origin)[np.newaxis], covariance=self.covariance(),
            n_points=np.array([len(cloud)], dtype=np.int64), rms_m=np.zeros(1),
            names=("plane 0",), up=np.array([0.0, 0.0, 1.0]),
        )
        return self.Out(
            planes=planes, labels=PointLabels(plane_index=np.zeros(len(cloud), dtype=np.int16))
        )

    def listen(self, ctx):
        ctx.progress(0.0, "looking")

    def covariance(self):
        return 1e-9 * np.eye(4)[np.newaxis]

    def look_at(self, cloud):
        cloud.require_points(3)

    def lift_m(self, cloud, ctx):
        return 0.0
"""
# Results of which need not repeat.
LOOSE = """

class Guess(Floor):
    id = "plane.guess"
    determinism = "loose"

    def lift_m(self, cloud, ctx):
        return float(np.random.default_rng().random())
"""
# Name of the cheat -> the check that must notice it, its sentence, and how the cheat cheats.
CHEATS: dict[str, tuple[str, str, str]] = {
    "unitless": (
        "parameters-are-documented",
        "the name of parameter tolerance lacks a unit: end it with one of m, mm, m2, px",
        """
        class Params(MethodParams):
            tolerance: float | None = Field(None, description="Near enough.")
            least_m_between: float | None = Field(None, description="How far apart.")
            lift_m: float = Field(0.0, description="Raises the plane.")
        """,
    ),
    "undescribed": (
        "parameters-are-documented",
        "parameter n_trials has no default; parameter lift_m has no description",
        """
        class Params(MethodParams):
            n_trials: int = Field(description="How often.")
            lift_m: float = 0.0
        """,
    ),
    "unitless_metric": (
        "outputs-are-valid",
        "metric n_walls is not declared by the method",
        """
        metrics = ("n_planes",)

        def listen(self, ctx):
            ctx.progress(0.0)
            ctx.metric("n_walls", 1.0, "1")
        """,
    ),
    "mislabelling": (
        "outputs-are-valid",
        "output labels is invalid: labels.plane_index must be -1 or the index of one of 1 planes",
        """
        def run(self, inputs, params, ctx):
            made = super().run(inputs, params, ctx)
            return self.Out(
                planes=made.planes, labels=PointLabels(plane_index=made.labels.plane_index + 5)
            )
        """,
    ),
    "lenient": (
        "parameters-round-trip",
        "an unknown parameter is accepted",
        """
        class Params(MethodParams):
            model_config = ConfigDict(extra="ignore", frozen=True)
            lift_m: float = Field(0.0, description="Raises the plane.")
        """,
    ),
    "boasting": (
        "stated-errors-of-planes-hold",
        "distances of true corners from planes are",
        """
        def covariance(self):
            return 1e-16 * np.eye(4)[np.newaxis]
        """,
    ),
    "timid": (
        "stated-errors-of-planes-hold",
        "distances of true corners from planes are",
        """
        def covariance(self):
            return np.eye(4)[np.newaxis]
        """,
    ),
    "meddling": (
        "inputs-stay-untouched",
        "changed inputs: cloud",
        """
        def lift_m(self, cloud, ctx):
            cloud.x.flags.writeable = True
            cloud.x[0] += 1.0
            return 0.0
        """,
    ),
    "global_dice": (
        "global-state-stays-untouched",
        "uses numpy's global random generator",
        """
        def lift_m(self, cloud, ctx):
            np.random.rand()
            return 0.0
        """,
    ),
    "littering": (
        "nothing-is-written-outside-scratch",
        "files were written outside the scratch folder: cwd/notes.txt, home/.floor",
        """
        def lift_m(self, cloud, ctx):
            pathlib.Path("notes.txt").write_text("here")
            (pathlib.Path.home() / ".floor").write_text("and here")
            return 0.0
        """,
    ),
    "unseeded": (
        "results-repeat",
        "differs between two runs with the same seed in the same process",
        """
        def lift_m(self, cloud, ctx):
            return float(np.random.default_rng().random())
        """,
    ),
    "misspelling": (
        "outputs-are-valid",
        "tolerances of planes name no field: planes.offset",
        """
        def run(self, inputs, params, ctx):
            class Misspelt(Planes):
                tolerances = {"planes.offset": None}

            made = super().run(inputs, params, ctx)
            return self.Out(planes=Misspelt(**vars(made.planes)), labels=made.labels)
        """,
    ),
    "hashing": (
        "results-repeat",
        "differs in a new process",
        """
        def lift_m(self, cloud, ctx):
            return hash("floor") / 2.0**56  # in -128 .. 128
        """,
    ),
    "counting_cores": (
        "threads-do-not-show",
        "depends on the number of cores",
        """
        def lift_m(self, cloud, ctx):
            return ctx.cores / 1000.0
        """,
    ),
    "backwards": (
        "progress-never-goes-back",
        "progress decreases from 0.800 to 0.300",
        """
        def lift_m(self, cloud, ctx):
            ctx.progress(0.8)
            ctx.progress(0.3)
            return 0.0
        """,
    ),
    "deaf": (
        "cancel-is-honoured",
        "a cancelled step ran to completion",
        """
        def listen(self, ctx):
            pass
        """,
    ),
    "overflowing": (
        "a-huge-coordinate-does-no-harm",
        "a cloud with a coordinate of 1e30 m raises ValueError",
        """
        def lift_m(self, cloud, ctx):
            np.zeros(int(cloud.x.max() / 1e-3) % 10**6 - 10**7 * (cloud.x.max() > 1e6))
            return 0.0
        """,
    ),
    "careless": (
        "empty-cloud-is-refused",
        "a cloud with no points raises IndexError instead of an OrthoflowError",
        """
        def look_at(self, cloud):
            cloud.x[0]
        """,
    ),
    "rounding": (
        "planes-follow-a-rigid-motion",
        "from the nearest true plane",
        """
        def lift_m(self, cloud, ctx):
            return float(np.float32(cloud.origin[2])) - float(cloud.origin[2]) + 0.01
        """,
    ),
}

# Our own methods, with results that lie beside the truth: what each does, and what is said of it.
BESIDE = """
from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.orient.pnp import OrientPnp


class Sure(OrientPnp):
    id = "orient.sure"

    def run(self, inputs, params, ctx):
        made = super().run(inputs, params, ctx)
        cameras = made.cameras.cameras
        surer = tuple(replace(each, covariance=1e-8 * each.covariance) for each in cameras)
        return replace(made, cameras=replace(made.cameras, cameras=surer))


class Cell(MosaicSeams):
    id = "mosaic.cell"

    def run(self, inputs, params, ctx):
        made = super().run(inputs, params, ctx).orthoimages
        images = tuple(replace(each, rgb=np.roll(each.rgb, 1, axis=1)) for each in made.images)
        return self.Out(orthoimages=replace(made, images=images))
"""
BESIDE_SAYS = {
    "mosaic.cell": ("mosaics-show-cells-in-place", "wall 0 at 0.006 m: colours are shifted by "),
    "orient.sure": ("stated-errors-of-poses-hold", "times the standard deviations"),
}


# Errors that stop every run are reported by the first check that runs the method.
STOPPED = """
        def look_at(self, cloud):
            return {}["tolerance"]
"""


@pytest.fixture
def cheats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a method that keeps the rules and one for every way to break them."""
    bodies = {name: body for name, (_, _, body) in CHEATS.items()} | {"wrong_key": STOPPED}
    classes = "".join(
        f'\n\nclass {name.title().replace("_", "")}(Floor):\n    id = "plane.{name}"\n'
        + textwrap.indent(textwrap.dedent(body), "    ")
        for name, body in bodies.items()
    )
    listing = ", ".join(
        f'MethodSpec(id="plane.{name}", target="floors:{name.title().replace("_", "")}", '
        f'summary="For a test.")'
        for name in ("floor", *bodies)
    )
    listing += "".join(
        f', MethodSpec(id="{method_id}", target="beside:{method_id.partition(".")[2].title()}", '
        'summary="For a test.")'
        for method_id in BESIDE_SAYS
    )
    listing += ', MethodSpec(id="plane.guess", target="floors:Guess", summary="For a test.")'
    hooks = (
        "from orthoflow.sdk.hooks import MethodSpec, hookimpl\n\n\n"
        f"@hookimpl\ndef orthoflow_methods():\n    return [{listing}]\n"
    )
    folder = write_distribution(
        tmp_path / "site",
        "cheats",
        {"floors.py": HONEST + LOOSE + classes, "beside.py": BESIDE, "cheats_hooks.py": hooks},
    )
    monkeypatch.syspath_prepend(folder)
    # A cheat that litters does so here too, where it runs in this process.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))


def case_of(method_id: str, check: str) -> ConformanceCase:
    (case,) = (case for case in conformance_cases(method_id) if case.check.name == check)
    return case


BROKEN = {f"plane.{cheat}": (check, said) for cheat, (check, said, _) in CHEATS.items()}
LONGER = {
    "nothing-is-written-outside-scratch",
    "results-repeat",
    "a-huge-coordinate-does-no-harm",
    "planes-follow-a-rigid-motion",
    "stated-errors-of-planes-hold",
}


@pytest.mark.usefixtures("cheats")
@pytest.mark.parametrize("method_id", BROKEN | BESIDE_SAYS)
def test_a_broken_rule_is_noticed_and_named(method_id: str) -> None:
    check, sentence = (BROKEN | BESIDE_SAYS)[method_id]
    with pytest.raises(ConformanceError) as caught:
        case_of(method_id, check).run()
    assert str(caught.value).startswith(f"{method_id}-{check}: ")
    assert sentence in str(caught.value)


@pytest.mark.usefixtures("cheats")
def test_inputs_that_a_method_changed_are_as_before_for_the_next_one() -> None:
    cloud, _ = example_room(n_points=1000)
    before = digest_of(cloud)
    cases = conformance_cases("plane.meddling", inputs={"cloud": cloud})
    (case,) = (case for case in cases if case.check.name == "inputs-stay-untouched")
    assert case.problem() == "changed inputs: cloud"
    assert digest_of(cloud) == before


@pytest.mark.usefixtures("cheats")
def test_results_of_a_loose_method_need_not_repeat() -> None:
    case_of("plane.guess", "results-repeat").run()
    assert "threads-do-not-show" not in {one.check.name for one in conformance_cases("plane.guess")}


def quickly_checked(method_id: str) -> tuple[int, dict[str, str]]:
    """Exit code and states of the checks that `plugins check --quick` tells of."""
    result = asked("plugins", "check", method_id, "--quick", "--json")
    return result.exit_code, {
        item["check"]: item["state"] for item in json.loads(result.stdout)["checks"]
    }


@pytest.mark.usefixtures("cheats")
def test_quick_checks_take_two_runs_and_say_what_they_leave_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs: list[int] = []

    def run(trial: Trial, *_: object, **__: object) -> TrialRun:
        runs.append(trial.cores)
        return run_trial(trial, *_, **__)  # type: ignore[arg-type]

    monkeypatch.setattr(subjects, "run_trial", run)
    code, states = quickly_checked("plane.floor")
    # The example on one core and on two; clouds that are refused, and a step that was cancelled.
    assert runs == [1, 2, 1, 1, 1]
    assert code == 0
    left_out = {name for name, state in states.items() if state == "left out"}
    assert left_out == LONGER
    assert {states[name] for name in states.keys() - left_out} == {"kept"}
    # The rules of other kinds, and golden digests, are about no method that finds planes.
    assert {case.check.name for case in conformance_cases("plane.floor")} == set(states)


@pytest.mark.usefixtures("cheats")
def test_an_expected_failure_that_passes_is_reported() -> None:
    expected = {"threads-do-not-show": "counts its cores"}
    cases = conformance_cases("plane.floor", expected_failures=expected)
    (case,) = (case for case in cases if case.check.name == "threads-do-not-show")
    with pytest.raises(ConformanceError, match="passes, although it was expected to fail"):
        case.run()


@pytest.mark.usefixtures("cheats")
def test_a_result_that_moved_without_its_version_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    golden = tmp_path / "golden.json"

    def problem() -> str:
        cases = conformance_cases("plane.floor", golden=golden)
        (case,) = (case for case in cases if case.check.name == "golden-digest-holds")
        return case.problem()

    assert [problem(), problem()] == ["", ""]
    recorded = golden.read_text()
    floor = discover_catalog().method("plane.floor").load()
    monkeypatch.setattr(floor, "lift_m", lambda self, cloud, ctx: 0.1)
    assert problem() == (
        "output planes differs from golden.json (4 of 12 sampled values of corners "
        "changed), but result_version is still 1: increment it, or find out why the result has "
        "changed"
    )
    assert golden.read_text() == recorded


@pytest.mark.usefixtures("cheats")
def test_what_stops_every_run_is_told_once_and_where() -> None:
    result = asked("plugins", "check", "plane.wrong_key", "--quick", code=1)
    said = r"on the suite's inputs the method raised KeyError: 'tolerance' \(floors\.py:\d+\)"
    assert re.findall(rf"^broken   outputs-are-valid: {said}$", result.stdout, re.MULTILINE)
    assert result.stdout.count("broken ") == 1
    skipped = "skipped  inputs-stay-untouched: stopped by the same problem as outputs-are-valid"
    assert skipped in result.stdout
    assert "a cloud with" not in result.stdout


def test_an_expected_failure_needs_a_check_and_a_reason() -> None:
    for expected in ({"no-such-check": "why"}, {"results-repeat": " "}):
        with pytest.raises(ArgumentError, match="needs the name of a check and a reason"):
            conformance_cases("plane.hough2d", expected_failures=expected)


# How far beside the truth a result may lie: below each limit it passes, above it is named ---------


@pytest.fixture(scope="module")
def truth() -> Planes:
    _, planes = example_room(n_points=1000)
    return planes


@pytest.mark.parametrize(("angle_deg", "fits"), [(0.015, True), (0.03, False)])
def test_planes_may_be_a_fiftieth_of_a_degree_off(
    truth: Planes, angle_deg: float, fits: bool
) -> None:
    turn = math.radians(angle_deg)
    beside = np.linalg.svd(truth.normal[0][None])[2][1]
    normal = math.cos(turn) * truth.normal[0] + math.sin(turn) * beside
    # Turned about the middle of the rectangle, which so stays on the plane.
    offset = truth.corners[0].mean(axis=0) @ normal
    found = replace(
        truth,
        normal=np.vstack([normal, truth.normal[1:]]),
        offset=np.append(offset, truth.offset[1:]),
    )
    if fits:
        physics.match_planes(found, truth)
        return
    with pytest.raises(
        AssertionError, match=r"plane 0 of a rotated and shifted room is 0\.030 deg and 0\.00 mm"
    ):
        physics.match_planes(found, truth)


def oriented(shift_m: float) -> Any:
    """A subject that finds both photos, shifted along the wall."""
    found = [
        photographed.oriented(
            photographed.nudged(camera, (0.0, 0.0, 0.0, shift_m, 0.0, 0.0)), name=name
        )
        for name, camera in photographed.PHOTOGRAPHING.items()
    ]
    run = SimpleNamespace(outputs={"cameras": photographed.cameras(*found)})
    return SimpleNamespace(run_on_photographs=lambda: run)


def test_photos_may_be_oriented_a_little_beside_their_true_pose() -> None:
    # A shift along the wall moves every pixel's place by as much: 1 mm is 0.7 mm per coordinate.
    physics.poses_are_recovered(oriented(0.001))
    with pytest.raises(AssertionError, match=r"the pose of a\.png is off by 0\.99 mm on the wall"):
        physics.poses_are_recovered(oriented(0.0014))


def test_a_photo_that_is_not_oriented_is_named() -> None:
    lost = replace(oriented(0.0).run_on_photographs().outputs["cameras"].cameras[1], status="few")
    for cameras, said in (
        (photographed.cameras(lost), r"b\.png was not oriented: few"),
        (None, "output cameras is missing"),
    ):
        run = SimpleNamespace(outputs={"cameras": cameras})
        subject: Any = SimpleNamespace(run_on_photographs=lambda run=run: run)
        with pytest.raises(AssertionError, match=said):
            physics.poses_are_recovered(subject)


def layer(
    *, columns: float = 0.0, rows: float = 0.0, share: float = 1.0, lighter: int = 0
) -> Layer:
    """The wall in its true colours, shifted, in a share of its columns, and made lighter."""
    scene = photographed.textured_wall(gsd_m=0.01)
    frame = scene.frame
    across, down = photographed.places_of_cells(frame)
    grey = scene.grey(across - columns * frame.gsd_m, down - rows * frame.gsd_m)
    shown = np.broadcast_to(np.arange(frame.width) < share * frame.width, frame.shape)
    values = np.clip(np.rint(255.0 * grey) + lighter, 0, 255).astype(np.uint8)
    return Layer(
        frame=frame,
        wall=0,
        source="a.png",
        rgb=np.repeat(values[..., None], 3, axis=2),
        mask=np.where(shown, LayerMask.PAINTED, LayerMask.OUTSIDE).astype(np.uint8),
        quality=np.ones(frame.shape, dtype=np.float32),
    )


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (
            {"columns": 0.3},
            r"a\.png at 0\.01 m: colours are shifted by -0\.\d\d columns and [+-]0\.0\d rows",
        ),
        ({"rows": -0.3}, r"colours are shifted by [+-]0\.0\d columns and \+0\.\d\d rows"),
        ({"share": 0.25}, r"only 25% of the wall is covered"),
        ({"lighter": 24}, r"half of the colours are wrong by 2\d grey levels or more"),
    ],
    ids=str,
)
def test_cells_that_show_another_place_are_reported(image: dict[str, Any], message: str) -> None:
    shown = layer(**image)
    scene = photographed.textured_wall(gsd_m=0.01)
    with pytest.raises(AssertionError, match=message):
        physics.check_cells(scene, shown, "a.png", shown.mask == LayerMask.PAINTED)


@pytest.mark.parametrize(("hidden", "passes"), [(0.02, True), (0.05, False)])
def test_a_mosaic_paints_what_its_layers_show(hidden: float, passes: bool) -> None:
    def run_on(**inputs: object) -> object:
        (left, right) = inputs["layers"].layers  # type: ignore[attr-defined]
        rgb = np.where(left.mask[..., None] == LayerMask.PAINTED, left.rgb, right.rgb)
        mask = np.full(left.frame.shape, OrthoMask.PAINTED, dtype=np.uint8)
        mask[: round(hidden * len(mask))] = OrthoMask.OCCLUDED
        image = samples.orthoimage(left.frame, rgb=rgb, mask=mask, sources=("left", "right"))
        return SimpleNamespace(outputs={"orthoimages": Orthoimages(images=(image,))})

    subject: Any = SimpleNamespace(run_on_photographs=run_on)
    if passes:
        physics.mosaics_show_cells_in_place(subject)
        return
    with pytest.raises(AssertionError, match=r"wall 0 at 0\.006 m: only 95% of the wall is"):
        physics.mosaics_show_cells_in_place(subject)
