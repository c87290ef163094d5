"""The examples of the conformance suite, and golden results, which hold on any machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoflow.engine.store import digest_of
from orthoflow.errors import InputError
from orthoflow.products import Photos, Planes, PointCloud, Product, Truth, Walls
from orthoflow.sdk import Method, MethodParams, Ports
from orthoflow.testing import examples
from orthoflow.testing.examples import (
    ExampleError,
    example,
    example_inputs,
    example_room,
)
from orthoflow.testing.golden import golden_problem, sample_of, sample_problem
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
from orthoflow.testing.trials import Trial

SIZE_M = np.array([5.0, 3.6, 2.6])
# Axis and direction that each side looks to.
SIDES = ((1, -1), (1, 1), (0, -1), (0, 1), (2, 1), (2, -1))


def test_a_room_is_a_box_of_points_on_planes_that_are_known() -> None:
    cloud, planes = example_room(n_points=6000)
    points, first = cloud.points_world(), 0
    for index, (axis, direction) in enumerate(SIDES):
        count = int(6000 / SIZE_M[axis] / sum(1.0 / SIZE_M[a] for a, _ in SIDES))
        on_side = points[first : first + count]
        first += count
        assert planes.n_points[index] == count
        np.testing.assert_array_equal(planes.normal[index], direction * np.eye(3)[axis])
        # It looks into the room: the middle lies half a side before it.
        assert planes.offset[index] == -0.5 * SIZE_M[axis]
        distances = on_side @ planes.normal[index] - planes.offset[index]
        assert np.std(distances) == pytest.approx(planes.rms_m[index], rel=0.15)
        assert abs(np.mean(distances)) < 4.0 * 0.002 / np.sqrt(count)
        others = [other for other in range(3) if other != axis]
        reach = np.abs(on_side[:, others]).max(axis=0) / SIZE_M[others]
        assert ((reach > 0.49) & (reach < 0.5)).all()
        corners = planes.corners[index]
        np.testing.assert_allclose(corners @ planes.normal[index], planes.offset[index])
        # Round the side, not across it.
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(sorted(lengths), sorted([*SIZE_M[others]] * 2))
    assert first == len(cloud)
    assert cloud.stations is not None
    assert not cloud.stations.any()
    assert cloud.rgb is not None
    assert cloud.intensity is not None
    np.testing.assert_allclose(cloud.intensity, cloud.rgb[:, 0] / 255.0, rtol=1e-6)


class _Idle(Method):
    def run(self, inputs: object, params: object, ctx: object) -> object:
        raise NotImplementedError


class Photographing(_Idle):
    class In(Ports):
        photos: Photos
        walls: Walls
        cloud: PointCloud | None = None


class Surveying(_Idle):
    class In(Ports):
        planes: Planes
        cloud: PointCloud | None = None
        truth: Truth | None = None


def test_what_a_method_gets_is_of_one_scene_and_a_truth_wherever_it_takes_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # To render photos takes seconds.
    for scene, ports in (("PHOTOGRAPHED", "photos walls ties"), ("SURVEYED", "planes truth")):
        makers = {port: lambda made=f"{port} of {scene}": made for port in ports.split()}
        monkeypatch.setattr(examples, scene, makers)
    assert example_inputs(Photographing) == {
        "photos": "photos of PHOTOGRAPHED",
        "walls": "walls of PHOTOGRAPHED",
    }
    assert list(example_inputs(Photographing, besides=("photos",))) == ["walls"]
    names = ("planes", "truth")
    assert example_inputs(Surveying) == {name: f"{name} of SURVEYED" for name in names}
    assert example_inputs(Surveying, besides=names) == {}
    assert example("ties") == "ties of PHOTOGRAPHED"
    with pytest.raises(ExampleError, match="there is no example of a dent product, and no "):
        example("dent")


_DIGESTS = """
import json
from orthoflow.engine.store import digest_of
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
scenes = (SURVEYED, PHOTOGRAPHED)
print(json.dumps([digest_of(make()) for scene in scenes for make in scene.values()]))
"""


def test_examples_keep_their_bits_without_wide_instructions() -> None:
    switched_off = {"NPY_DISABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_CORETYPE": "Nehalem"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _DIGESTS],
        env={**os.environ, **switched_off, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    scenes = (SURVEYED, PHOTOGRAPHED)
    here = [digest_of(make()) for scene in scenes for make in scene.values()]
    assert json.loads(done.stdout) == here


# Examples that methods of ours take, each held by what they gave for it.
TAKEN = {
    "surveyed": ("cloud", "planes"),
    "photographed": ("photos", "cameras", "ties", "walls", "layers", "cloud"),
}


def test_golden_results_are_of_these_examples() -> None:
    """Where an example moved, every result of it would be recorded anew and none be held."""
    golden = json.loads((Path(__file__).parents[1] / "golden.json").read_text())
    recorded = [item for result in golden.values() for item in result["inputs"].items()]
    for scene, makers in (("surveyed", SURVEYED), ("photographed", PHOTOGRAPHED)):
        for port in TAKEN[scene]:
            assert (port, sample_of(makers[port]())) in recorded, (scene, port)


class Mine(Method):
    """A method whose results the tests make up."""

    id = "plane.mine"
    Params = MethodParams
    In = Ports
    Out = Ports


def planes(lift_m: float = 0.0) -> Planes:
    _, truth = example_room()
    return replace(truth, offset=truth.offset + lift_m)


def trial(*, input_lift_m: float = 0.0, **params: object) -> Trial:
    return Trial(method=Mine, inputs={"before": planes(input_lift_m)}, params=params)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A golden file with the planes of the room."""
    path = tmp_path / "golden.json"
    assert golden_problem(path, trial(), {"planes": planes()}) == ""
    return path


MOVED = "output planes differs from golden.json (6 of 6 sampled values of offset changed)"


def test_a_result_that_moved_is_noticed_and_not_recorded(file: Path) -> None:
    before = file.read_text()
    assert golden_problem(file, trial(), {"planes": planes(1e-9)}) == ""
    assert golden_problem(file, trial(), {"planes": planes(2e-5)}).startswith(MOVED)
    assert file.read_text() == before


def test_a_raised_version_or_another_tool_records_anew(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mine, "result_version", 2)
    assert golden_problem(file, trial(), {"planes": planes(0.1)}) == ""
    assert golden_problem(file, trial(), {"planes": planes()}).startswith(MOVED)
    monkeypatch.setattr(Mine, "tools", classmethod(lambda cls: {"library": "2.0"}))
    assert golden_problem(file, trial(), {"planes": planes()}) == ""


def test_a_result_of_something_else_records_anew(file: Path) -> None:
    moved = {"planes": planes(0.1)}
    assert golden_problem(file, trial(input_lift_m=1e-9), moved).startswith(MOVED)
    assert golden_problem(file, trial(input_lift_m=1e-9), {"planes": planes(1e-9)}) == ""
    assert golden_problem(file, trial(input_lift_m=0.1), moved) == ""
    assert golden_problem(file, trial(input_lift_m=0.1), {"planes": planes()}).startswith(MOVED)
    assert golden_problem(file, trial(input_lift_m=0.1, cell_m=0.2), {"planes": planes()}) == ""


def stating(*rmse_grey: float, lift_m: float = 0.0) -> Mapping[str, Product]:
    """Planes that say something of themselves, as an inspection does: an RMSE over few cells."""
    return {"planes": replace(planes(lift_m), details={"rmse_grey": list(rmse_grey)})}


def test_what_other_numbers_went_into_is_held_to_its_tolerances_alone(tmp_path: Path) -> None:
    file = tmp_path / "golden.json"
    assert golden_problem(file, trial(), stating(19.55, 4.09, 0.0259)) == ""
    before, elsewhere = file.read_text(), trial(input_lift_m=2e-6)
    assert golden_problem(file, elsewhere, stating(20.23, 4.20, 0.0254)) == ""
    lifted = stating(20.23, 4.20, 0.0254, lift_m=2e-5)
    assert golden_problem(file, elsewhere, lifted).startswith(MOVED)
    one_less = golden_problem(file, elsewhere, stating(20.23, 4.20))
    assert "(only one of the results has metadata [3])" in one_less
    assert file.read_text() == before


def test_an_output_that_appears_and_another_file_are_noticed(file: Path) -> None:
    for port, outputs in (("planes", {}), ("walls", {"planes": planes(), "walls": planes()})):
        problem = golden_problem(file, trial(), outputs)
        assert problem.startswith(f"output {port} differs from golden.json (only one of the result")
    file.write_text('{"plane.mine": {"1": {}}}')
    with pytest.raises(InputError, match=r"is not a valid file of golden results .*: remove it"):
        golden_problem(file, trial(), {"planes": planes()})


@pytest.mark.parametrize(("factor", "is_noticed"), [(0.9, False), (1.2, True)])
def test_what_states_no_tolerance_may_differ_by_a_millionth(
    factor: float, is_noticed: bool
) -> None:
    for before, after in ((0.0, factor * 1e-6), (1e3, 1e3 + factor * 1e-3)):
        pair = ({"a [1]": [value]} for value in (before, after))
        assert bool(sample_problem(*pair, {})) is is_noticed


@pytest.mark.parametrize(("n_moved", "is_noticed"), [(2, False), (3, True)])
def test_one_of_sixteen_sampled_values_may_stray(n_moved: int, is_noticed: bool) -> None:
    moved = [1.0] * n_moved + [0.0] * (32 - n_moved)
    pair = ({"a [32]": values} for values in ([0.0] * 32, moved))
    assert bool(sample_problem(*pair, {})) is is_noticed
