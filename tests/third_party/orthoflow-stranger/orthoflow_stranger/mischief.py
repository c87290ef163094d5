"""Methods that fail in every way a method can."""

from __future__ import annotations

import os
import time

import numpy as np

from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


class _Mischief(Method):
    class Params(MethodParams):
        pass

    class In(Ports):
        cloud: PointCloud

    class Out(Ports):
        planes: Planes


class Crash(_Mischief):
    """Dies of a segmentation fault."""

    id = "mischief.crash"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        import ctypes

        ctypes.string_at(0)
        return None


class Eat(_Mischief):
    """Takes memory until somebody stops it."""

    id = "mischief.eat"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        hoard = []
        while True:
            hoard.append(np.ones(32_000_000))
            time.sleep(0.02)


class Hang(_Mischief):
    """Never ends, and does not listen when asked to."""

    id = "mischief.hang"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        import signal

        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(1)


class Raise(_Mischief):
    """Raises something that no caller expects."""

    id = "mischief.raise"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        return {}["missing"]


class Exit(_Mischief):
    """Leaves the process without a word."""

    id = "mischief.exit"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        os._exit(17)


class Fill(_Mischief):
    """Finds the disk full."""

    id = "mischief.fill"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        import errno

        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(ctx.scratch / "big"))


class Meddle(_Mischief):
    """Writes to its inputs."""

    id = "mischief.meddle"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        inputs.cloud.x[0] = 1.0
        return Good().run(inputs, params, ctx)


class Wrong(_Mischief):
    """Returns what it was not asked for."""

    id = "mischief.wrong"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        return self.Out(planes=inputs.cloud)


class Good(_Mischief):
    """Does what it should, in bad company."""

    id = "mischief.good"

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        from orthoflow_stranger.median import MedianPlanes

        found = MedianPlanes().run(MedianPlanes.In(cloud=inputs.cloud), MedianPlanes.Params(), ctx)
        return self.Out(planes=found.planes)
