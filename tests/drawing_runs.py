"""A run on a box room with one photographed wall, written as runs are, for drawings of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from click.testing import Result
from numpy.typing import NDArray
from orthoflow_provenance.document import PublishedFile, RecordedProduct
from orthoflow_provenance.record import write_record
from scipy.spatial.transform import Rotation

from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.store import digest_of
from orthoflow.files.publishing import (
    publish_openings,
    publish_orthoimages,
    publish_planes,
    publish_walls,
)
from orthoflow.geometry import WallFrame
from orthoflow.geometry.frames import frame_over
from orthoflow.products import (
    CheckPoints,
    Inspection,
    Opening,
    Openings,
    Orthoimage,
    Orthoimages,
    OrthoMask,
    Planes,
    PointLabels,
    Wall,
)
from orthoflow.products.inspections import Finding
from orthoflow.products.product import Payload, Product
from tests import samples
from tests.provenance_records import ProductShelf
from tests.report_runs import cell, metrics, record
from tests.studios import asked

# As far from the origin as survey coordinates are, and turned.
CORNER = np.array([4.0e5, 5.0e6, 100.0])
SIZE_M = (4.0, 3.0, 2.5)
AXES = Rotation.from_euler("z", -20.0, degrees=True).as_matrix()
# How far the points of a plane stay from the edges of the room.
GAP_M = 0.1
# The photographed wall is the third of the planes: numbers are not places among walls.
WALL = 2
GSD_M = 0.01


def box_points(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """World points (n, 3) of places (n, 3) in the box, metres from its lowest corner."""
    return CORNER + places @ AXES


def box_planes() -> Planes:
    """The six planes of the box: floor, ceiling, then walls, the third of all along y = 3 m."""
    x, y, z = SIZE_M
    quads = [
        ([0, y, 0], [0, 0, 0], [x, 0, 0], [x, y, 0]),
        ([0, 0, z], [0, y, z], [x, y, z], [x, 0, z]),
        ([0, y, z], [0, y, 0], [x, y, 0], [x, y, z]),
        ([x, y, z], [x, y, 0], [x, 0, 0], [x, 0, z]),
        ([x, 0, z], [x, 0, 0], [0, 0, 0], [0, 0, z]),
        ([0, 0, z], [0, 0, 0], [0, y, 0], [0, y, z]),
    ]
    whole = np.array(quads, dtype=np.float64)
    inwards = np.array([[0, 0, 1], [0, 0, -1], [0, -1, 0], [-1, 0, 0], [0, 1, 0], [1, 0, 0]])
    middle = whole.mean(axis=1, keepdims=True)
    seen = whole - GAP_M * np.sign(np.round(whole - middle, 9))
    normal = inwards @ AXES
    corners = np.array([box_points(quad) for quad in seen])
    return samples.planes(
        normal=normal,
        offset=np.einsum("ki,ki->k", normal, corners.mean(axis=1)),
        corners=corners,
        n_points=np.arange(6000, 0, -1000, dtype=np.int64),
        rms_m=np.full(6, 0.002),
        names=("floor 0", "ceiling 1", "wall 2", "wall 3", "wall 4", "wall 5"),
    )


def wall_frame(planes: Planes) -> WallFrame:
    """Cells over the photographed wall's rectangle: 3.8 x 2.3 m."""
    frame = frame_over(planes.corners[WALL], planes.normal[WALL], gsd_m=GSD_M)
    east, north, top = planes.up.tolist()
    return replace(frame, up=(east, north, top), name=planes.names[WALL])


def box_products(
    image: Orthoimage | None = None, others: tuple[Orthoimage, ...] = ()
) -> dict[str, Product]:
    """What the steps of the run give."""
    planes = box_planes()
    frame = wall_frame(planes)
    return {
        "plane": planes,
        "wall": samples.walls(_wall(frame), buffer_m=0.3, intensity_source="laser"),
        "mosaic": Orthoimages(images=(image or box_image(), *others)),
        "openings": box_openings(),
        "check": _inspection(frame),
        "points": _checkpoints(frame),
    }


def box_openings() -> Openings:
    """A niche of 0.8 x 1.2 m in the photographed wall, 0.5 m from its left edge and 0.6 from above.

    Its second side was found in the photo, its third by nobody.
    """
    frame = wall_frame(box_planes())
    cells = np.array([[0.5, 0.6], [0.5, 1.8], [1.3, 1.8], [1.3, 0.6]]) / GSD_M
    return Openings(
        openings=(
            Opening(
                wall=WALL,
                wall_name=f"wall {WALL}",
                kind="niche",
                outline_m=frame.raster_from_wall(cells),
                outline_world=frame.world_from_wall(cells),
                side_sigma_m=np.array([0.003, 0.0015, np.nan, 0.003]),
                side_source=np.array([0, 1, 2, 0], dtype=np.uint8),
                depth_m=0.25,
                area_m2=0.96,
                width_m=0.8,
                height_m=1.2,
                sill_m=0.5,
                seen_share=0.75,
            ),
        ),
        walls=(WALL,),
    )


def publish_box(
    folder: Path, image: Orthoimage | None = None, others: tuple[Orthoimage, ...] = ()
) -> tuple[PublishedFile, ...]:
    """Write `products/` of a run folder, and say what lies there."""
    products = box_products(image, others)
    for step, publish in (
        ("plane", publish_planes),
        ("wall", publish_walls),
        ("mosaic", publish_orthoimages),
        ("openings", publish_openings),
    ):
        into = folder / "products" / step
        into.mkdir(parents=True)
        publish(products[step], into, digest_of(products[step]))  # type: ignore[operator] # each its own
    files = sorted(path for path in (folder / "products").rglob("*") if path.is_file())
    return tuple(
        PublishedFile(
            path=path.relative_to(folder).as_posix(),
            size_bytes=path.stat().st_size,
            sha256=file_sha256(path),
        )
        for path in files
    )


# Which step takes what of which others, where there are any.
_TAKEN = {
    "plane": {"cloud": "scan"},
    "wall": {"planes": "plane"},
    "orient": {"photos": "photos"},
    "ortho": {"cameras": "orient", "photos": "photos"},
    "mosaic": {"walls": "wall", "layers": "ortho"},
    "openings": {"walls": "wall"},
    "check": {"orthoimages": "mosaic", "checkpoints": "points"},
}


def write_drawing_run(
    folder: Path,
    *,
    gains: str = "none",
    differ: bool = False,
    image: Orthoimage | None = None,
    others: tuple[Orthoimage, ...] = (),
    before: Mapping[str, Product] | None = None,
    labels: PointLabels | None = None,
    change: Callable[[Payload], Payload] = lambda payload: payload,
    **facts: object,
) -> Path:
    """Write `run.h5` and `products/` of planes, one wall, its orthoimage and its inspection.

    `before` are products of other steps, `change` damages any before it is digested, and `facts`
    are what all cells have.
    """
    folder.mkdir(parents=True)
    shelf = ProductShelf(folder)
    products = {**(before or {}), **box_products(image, others)}
    given = {step: _recorded(shelf, change(item.to_payload())) for step, item in products.items()}
    more = {"plane": [_recorded(shelf, change(labels.to_payload()))]} if labels else {}
    cells = [
        cell(
            step,
            params={"gains": gains} if step == "mosaic" else {},
            metrics=metrics(gain_max=1.2) if step == "mosaic" and differ else (),
            inputs={
                port: replace(given[source], source=f"{source}.{port}", embedded=False)
                for port, source in _TAKEN.get(step, {}).items()
                if source in given
            },
            outputs={one.type_name: one for one in (given[step], *more.get(step, ()))},
            **{"environment": "", **facts},
        )
        for step in (*(before or {}), "points", "plane", "wall", "openings", "mosaic", "check")
    ]
    made = record(cells, name="box", published=publish_box(folder, image, others), environments=())
    write_record(folder / "run.h5", made, shelf.find)
    return folder


def export(run: Path, target: str, folder: Path, *more: object, code: int | None = None) -> Result:
    """Export a run in a format into a folder, by the command."""
    return asked("export", run, "--to", target, "-o", folder, *more, code=code)


def _recorded(shelf: ProductShelf, payload: Payload) -> RecordedProduct:
    return RecordedProduct(
        type_name=payload.type_name,
        encoding_version=payload.encoding_version,
        digest=shelf.put(payload),  # type: ignore[arg-type] # a payload like any
        embedded=True,
    )


def _wall(frame: WallFrame) -> Wall:
    """A wall with a step: 40 mm before the plane on the right half."""
    depth = np.zeros(frame.shape, dtype=np.float32)
    depth[:, frame.width // 2 :] = 0.04
    return samples.wall(
        frame,
        name=f"wall {WALL}",
        plane_index=WALL,
        depth_m=depth,
        intensity=np.full(frame.shape, 0.5, dtype=np.float32),
        sigma_m=np.full(frame.shape, 0.001, dtype=np.float32),
    )


def box_image() -> Orthoimage:
    """Red grows to the right, green downwards; the ten rightmost columns show nothing."""
    frame = wall_frame(box_planes())
    rows, columns = np.indices(frame.shape)
    mask = np.full(frame.shape, OrthoMask.PAINTED, dtype=np.uint8)
    mask[:, -10:] = OrthoMask.NONE
    rgb = np.stack([columns // 2, rows, np.full(frame.shape, 128)], axis=2).astype(np.uint8)
    rgb[:, -10:] = 0
    return samples.orthoimage(
        frame,
        name=f"wall {WALL}",
        rgb=rgb,
        mask=mask,
        source=np.where(mask == OrthoMask.PAINTED, 0, -1).astype(np.int16),
        plane_index=WALL,
    )


def _inspection(frame: WallFrame) -> Inspection:
    """Two residuals: 1 mm to the right, 2 mm down."""
    return Inspection(
        wall=np.zeros(2, dtype=np.int32),
        points_world=frame.world_from_wall(np.array([[100.0, 100.0], [200.0, 100.0]])),
        displacement_m=np.array([[0.001, 0.0], [0.0, 0.002]]),
        kind=np.zeros(2, dtype=np.uint8),
        kinds=("check point",),
        findings=(
            Finding(name="rmse_x_mm", value=0.71, unit="mm", wall=0),
            Finding(name="rmse_y_mm", value=1.41, unit="mm", wall=0),
        ),
    )


def _checkpoints(frame: WallFrame) -> CheckPoints:
    places = np.array([[100.0, 100.0], [200.0, 100.0]])
    return CheckPoints(
        names=("P1", "P2\x1b]0;"),
        points_world=frame.world_from_wall(places),
        classes=("", ""),
        wall=np.full(2, -1, dtype=np.int32),
        pixels_wall=np.full((2, 2), np.nan),
    )
