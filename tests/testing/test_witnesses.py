"""What a watched run leaves behind: nothing that the next method's trial would notice."""

from __future__ import annotations

import numpy as np

from orthoflow.engine.store import digest_of
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from orthoflow.testing.examples import example_room
from orthoflow.testing.trials import Trial
from orthoflow.testing.witnesses import Witness


class Meddling(Method):
    """Moves the first point of its input."""

    id = "plane.meddling"

    Params = MethodParams

    class In(Ports):
        """What it spoils."""

        cloud: PointCloud

    class Out(Ports):
        """Nothing of interest."""

        planes: Planes

    def run(self, inputs: In, params: MethodParams, ctx: StepContext) -> Out:
        """Spoil it."""
        inputs.cloud.x.flags.writeable = True
        inputs.cloud.x[0] += 1.0
        return self.Out(planes=example_room()[1])


def test_inputs_that_a_method_changed_are_as_before_for_the_next_one() -> None:
    cloud, _ = example_room(n_points=1000)
    before = digest_of(cloud)
    first = Witness(Trial(method=Meddling, inputs={"cloud": cloud})).first
    assert first.changed_inputs == ("cloud",)
    assert digest_of(cloud) == before


def test_drawing_from_numpys_own_generator_is_seen() -> None:
    class Dicing(Meddling):
        id = "plane.dicing"

        def run(self, inputs: Meddling.In, params: MethodParams, ctx: StepContext) -> Meddling.Out:
            np.random.random()  # noqa: NPY002 - the global one is what is watched
            return self.Out(planes=example_room()[1])

    cloud, _ = example_room(n_points=1000)
    first = Witness(Trial(method=Dicing, inputs={"cloud": cloud})).first
    assert (first.changed_inputs, first.drew_globally) == ((), True)
