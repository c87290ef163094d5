"""What steps hand to each other: frozen dataclasses of named arrays and JSON, one per type."""

from orthoflow.products.cloud import PointCloud
from orthoflow.products.input_files import InputFiles
from orthoflow.products.inspections import CheckPoints, Finding, Inspection, TakenPhoto, Truth
from orthoflow.products.photographs import (
    Calibration,
    Camera,
    Cameras,
    Intrinsics,
    Photo,
    Photos,
    ResidualRow,
    TieRole,
    Ties,
    TieWall,
)
from orthoflow.products.planes import (
    Planes,
    PointLabels,
    ScanRow,
    SideSource,
    Spread,
    Thickness,
)
from orthoflow.products.product import Array, JsonValue, Payload, Product, Tolerance
from orthoflow.products.walls import (
    IntensitySource,
    Layer,
    LayerMask,
    Layers,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    SurfaceMask,
    Wall,
    Walls,
)

__all__ = [
    "Array",
    "Calibration",
    "Camera",
    "Cameras",
    "CheckPoints",
    "Finding",
    "InputFiles",
    "Inspection",
    "IntensitySource",
    "Intrinsics",
    "JsonValue",
    "Layer",
    "LayerMask",
    "Layers",
    "OrthoMask",
    "Orthoimage",
    "Orthoimages",
    "Payload",
    "Photo",
    "Photos",
    "Planes",
    "PointCloud",
    "PointLabels",
    "Product",
    "ResidualRow",
    "ScanRow",
    "SideSource",
    "Spread",
    "SurfaceMask",
    "TakenPhoto",
    "Thickness",
    "TieRole",
    "TieWall",
    "Ties",
    "Tolerance",
    "Truth",
    "Wall",
    "Walls",
]
