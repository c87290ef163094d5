"""Method classes with real ports and parameters, and nothing to run."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from orthoflow.products.cloud import PointCloud
from orthoflow.products.input_files import InputFiles
from orthoflow.products.inspections import Inspection, Truth
from orthoflow.products.photographs import Cameras, Photos, Ties
from orthoflow.products.planes import Planes
from orthoflow.products.surfaces import PointLabels
from orthoflow.products.walls import Layers, Orthoimages, Walls
from orthoflow.sdk import Method, MethodParams, Ports, StepContext


# Any: a type, or a union with None.
def ports(**types: Any) -> type[Ports]:
    """Ports of these types, which are optional where the type may be None."""
    optional = {name: None for name, kind in types.items() if type(None) in get_args(kind)}
    return type("SomePorts", (Ports,), {"__annotations__": types, **optional})


class Idle(Method):
    """Declares everything and computes nothing."""

    Params = MethodParams

    def run(self, inputs: object, params: object, ctx: StepContext) -> object:
        raise NotImplementedError


class ReadScan(Idle):
    id = "read.scan"
    In, Out = ports(files=InputFiles), ports(cloud=PointCloud)

    class Params(MethodParams):
        up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field("z", description="Upward axis.")


class ReadPhotos(Idle):
    id = "read.photos"
    In, Out = ports(files=InputFiles, calibration=InputFiles | None), ports(photos=Photos)


class SimulateRoom(Idle):
    id = "simulate.room"
    determinism = "seeded"
    In, Out = ports(), ports(cloud=PointCloud, photos=Photos, truth=Truth)


class Limits(BaseModel):
    """Nested parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    low_m: float = Field(0.0, description="Lower limit.")
    high_m: float = Field(1.0, description="Upper limit.")


class Hough2d(Idle):
    id = "plane.hough2d"
    result_version = 3
    In, Out = ports(cloud=PointCloud), ports(planes=Planes, labels=PointLabels)

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
    In, Out = ports(cloud=PointCloud, planes=Planes), ports(walls=Walls)

    class Params(MethodParams):
        gsd_m: float = Field(0.005, gt=0, description="Edge of a cell.")


class Sift(Idle):
    id = "match.sift"
    In, Out = ports(photos=Photos, walls=Walls), ports(ties=Ties)


class Guided(Sift):
    id = "match.guided"
    In = ports(photos=Photos, walls=Walls, cameras=Cameras)


class Pnp(Idle):
    id = "orient.pnp"
    In, Out = ports(ties=Ties, photos=Photos), ports(cameras=Cameras)


class Bundle(Pnp):
    id = "orient.bundle"
    determinism = "loose"


class Backward(Idle):
    id = "ortho.backward"
    In, Out = ports(walls=Walls, photos=Photos, cameras=Cameras), ports(layers=Layers)


class Direct(Backward):
    id = "ortho.direct"
    In = ports(walls=Walls, cloud=PointCloud)


class Seams(Idle):
    id = "mosaic.seams"
    In, Out = ports(layers=Layers), ports(orthoimages=Orthoimages)


class InspectTruth(Idle):
    id = "inspect.truth"
    In, Out = (
        ports(orthoimages=Orthoimages, walls=Walls, truth=Truth, planes=Planes | None),
        ports(inspection=Inspection),
    )
