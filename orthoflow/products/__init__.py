"""What steps hand to each other: frozen dataclasses of named arrays and JSON, one per type."""

from orthoflow.products.cloud import PointCloud
from orthoflow.products.input_files import InputFiles
from orthoflow.products.inspections import CheckPoints, Finding, Inspection, Truth
from orthoflow.products.photographs import (
    Calibration,
    Camera,
    Cameras,
    Intrinsics,
    Photo,
    Photos,
    TieRole,
    Ties,
)
from orthoflow.products.planes import Planes, PointLabels, ScanRow, Spread, Thickness
from orthoflow.products.product import Array, JsonValue, Payload, Product, Tolerance
from orthoflow.products.walls import (
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
    "ScanRow",
    "Spread",
    "SurfaceMask",
    "Thickness",
    "TieRole",
    "Ties",
    "Tolerance",
    "Truth",
    "Wall",
    "Walls",
]
