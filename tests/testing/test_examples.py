"""The room that methods are tried on, and which example a method gets."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.products import Photos, Planes, PointCloud, Truth, Walls
from orthoflow.sdk import Method, Ports
from orthoflow.testing import examples
from orthoflow.testing.examples import (
    ExampleError,
    example,
    example_inputs,
    example_room,
)

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
