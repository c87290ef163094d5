"""Method classes with real ports and parameters, and nothing to run."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from orthoflow.products.cloud import PointCloud
from orthoflow.products.input_files import InputFiles
from orthoflow.products.inspections import Inspection, Truth
from orthoflow.products.photographs import Cameras, Photos, Ties
from orthoflow.products.planes import Planes
from orthoflow.products.surfaces import PointLabels
from orthoflow.products.walls import Layers, Orthoimages, Walls
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


class Idle(Method):
    """Declares everything and computes nothing."""

    Params = MethodParams

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        raise NotImplementedError


class ReadScan(Idle):
    id = "read.scan"

    class Params(MethodParams):
        up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field("z", description="Upward axis.")

    class In(Ports):
        files: InputFiles

    class Out(Ports):
        cloud: PointCloud


class ReadPhotos(Idle):
    id = "read.photos"

    class In(Ports):
        files: InputFiles
        calibration: InputFiles | None = None

    class Out(Ports):
        photos: Photos


class SimulateRoom(Idle):
    id = "simulate.room"
    determinism = "seeded"

    class In(Ports):
        pass

    class Out(Ports):
        cloud: PointCloud
        photos: Photos
        truth: Truth


class Limits(BaseModel):
    """Nested parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low_m: float = Field(0.0, description="Lower limit.")
    high_m: float = Field(1.0, description="Upper limit.")


class Hough2d(Idle):
    id = "plane.hough2d"
    result_version = 3

    class Params(MethodParams):
        cell_m: float = Field(0.02, gt=0, description="Edge of an accumulator cell.")
        tolerance_m: float = Field(0.05, gt=0, description="Distance that counts as on the plane.")
        normal: tuple[float, float, float] | None = Field(None, description="Given direction.")
        limits: Limits = Field(Limits(), description="Heights to use.")

        @model_validator(mode="after")
        def _cell_is_finer_than_tolerance(self) -> Hough2d.Params:
            if self.cell_m > self.tolerance_m:
                raise ValueError(f"cell_m {self.cell_m} must not exceed tolerance_m")
            return self

    class In(Ports):
        cloud: PointCloud

    class Out(Ports):
        planes: Planes
        labels: PointLabels


class Ransac(Hough2d):
    id = "plane.ransac"
    result_version = 1
    determinism = "seeded"

    class Params(MethodParams):  # type: ignore[assignment]
        tolerance_m: Annotated[float, Field(gt=0)] | Literal["auto"] = Field(
            0.05, description="Distance that counts as on the plane."
        )
        iterations: int = Field(2000, ge=1, description="Trials.")


class Grid(Idle):
    id = "raster.grid"

    class Params(MethodParams):
        gsd_m: float = Field(0.005, gt=0, description="Edge of a cell.")

    class In(Ports):
        cloud: PointCloud
        planes: Planes

    class Out(Ports):
        walls: Walls


class Sift(Idle):
    id = "match.sift"

    class In(Ports):
        photos: Photos
        walls: Walls

    class Out(Ports):
        ties: Ties


class Guided(Sift):
    id = "match.guided"

    class In(Sift.In):
        cameras: Cameras


class Pnp(Idle):
    id = "orient.pnp"

    class In(Ports):
        ties: Ties
        photos: Photos

    class Out(Ports):
        cameras: Cameras


class Bundle(Pnp):
    id = "orient.bundle"
    determinism = "loose"


class Backward(Idle):
    id = "ortho.backward"

    class In(Ports):
        walls: Walls
        photos: Photos
        cameras: Cameras

    class Out(Ports):
        layers: Layers


class Direct(Backward):
    id = "ortho.direct"

    class In(Ports):  # type: ignore[assignment]
        walls: Walls
        cloud: PointCloud


class Seams(Idle):
    id = "mosaic.seams"

    class In(Ports):
        layers: Layers

    class Out(Ports):
        orthoimages: Orthoimages


class InspectTruth(Idle):
    id = "inspect.truth"

    class In(Ports):
        orthoimages: Orthoimages
        walls: Walls
        truth: Truth
        planes: Planes | None = None

    class Out(Ports):
        inspection: Inspection
