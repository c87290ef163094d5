"""Export of the registered cloud: selection of points, colours and file formats."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthoflow.cli.exports.choices import Choices
from orthoflow.cli.exports.products import (
    branch_of,
    last_product,
    make_empty,
    numbers_of,
    output_of,
    product_of,
    wanted_wall,
)
from orthoflow.cli.tables import counted
from orthoflow.errors import ArgumentError
from orthoflow.files.clouds.attributes import AttributedCloud, Colouring, describe_cloud
from orthoflow.files.clouds.copc import write_copc
from orthoflow.files.clouds.neighbourhoods import neighbourhoods_of
from orthoflow.files.clouds.photo_colours import UNSEEN_GREY, PointColours, colour_points
from orthoflow.files.clouds.writers import write_e57, write_laz, write_ply
from orthoflow.files.geotiff import epsg_of, epsg_wkt
from orthoflow.geometry.cameras import ViewingCamera
from orthoflow.geometry.slabs import Slab
from orthoflow.products import (
    Cameras,
    Photo,
    Photos,
    Planes,
    PointCloud,
    PointLabels,
    Surfaces,
    Walls,
)
from orthoflow.records.runs import Run


def export_cloud(
    name: str,
    write: Callable[[Path, AttributedCloud], int],
    run: Run,
    folder: Path,
    chosen: Choices,
) -> str:
    """Write the cloud to a file, and a description of the cloud to `cloud.json`."""
    is_labelled = chosen.cell is not None or any(
        output.type_name == "labels"
        for cell in run.cells.values()
        for output in cell.outputs.values()
    )
    address, port = output_of(run, "labels" if is_labelled else "cloud", chosen.cell)
    cells, recorded = branch_of(run, address), run.cell(address)
    digest = recorded.outputs[port].digest
    labels = planes = None
    if is_labelled:
        taken = [item.digest for item in recorded.inputs.values() if item.type_name == "cloud"]
        if len(taken) != 1:
            raise ArgumentError(
                f"it is unknown to which of {len(taken)} input clouds the labels of {address} "
                "belong"
            )
        labels = product_of(run, digest, PointLabels, chosen.store)
        digest = taken[0]
        if surfaces := last_product(run, {address: recorded}, Surfaces, chosen.store):
            planes = surfaces.planes
        else:
            planes = last_product(run, {address: recorded}, Planes, chosen.store)
    cloud = product_of(run, digest, PointCloud, chosen.store)
    if len(cloud) == 0:
        raise ArgumentError(f"the cloud of {address} has no points")
    cloud.require_points(1)
    if labels is not None and len(labels.plane_index) != len(cloud):
        raise ArgumentError(
            f"the labels have {len(labels.plane_index)} points, but the cloud has {len(cloud)}"
        )
    # Read the photos only if their colours may be used. The error message lists the colouring
    # `photos` in any case.
    is_wanted = chosen.colour in {None, "photos"}
    oriented = oriented_photos(run, cells, chosen) if is_wanted else ()
    has: dict[Colouring, bool] = {
        "photos": bool(oriented) if is_wanted else bool(_makers_of_cameras(cells)),
        "rgb": cloud.rgb is not None,
        "intensity": cloud.intensity is not None,
        "plane": labels is not None,
        "deviation": planes is not None or chosen.wall is not None,
    }
    can_show = [name for name, is_there in has.items() if is_there]
    if not can_show:
        raise ArgumentError(f"the cloud of {address} has no colours, intensities or planes to show")
    colouring = chosen.colour or can_show[0]
    if colouring not in can_show:
        raise ArgumentError(
            f"--colour {colouring}: the run lacks the required data ({address}); available: "
            f"{', '.join(can_show)}"
        )
    walls = last_product(run, cells, Walls, chosen.store)
    wall, wall_plane = _wall(walls, chosen.wall)
    attributed = AttributedCloud(
        cloud=cloud,
        colouring=colouring,
        neighbourhoods=neighbourhoods_of(cloud),
        planes=planes,
        labels=labels,
        photo_names=tuple(photo.name for photo, _ in oriented),
        wall=wall,
        wall_plane=wall_plane,
        box_world=_box(chosen.box),
        is_cleaned=chosen.clean,
        crs_wkt=common_crs_wkt(walls),
        name=digest,
    )
    if attributed.is_empty:
        raise ArgumentError(
            f"no points of the cloud of {address} are selected: choose another --wall or --box"
        )
    make_empty(folder)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        if colouring == "photos":
            colours = _photo_colours(cloud, oriented, Path(scratch))
            attributed = replace(attributed, photo_colours=colours)
        n_written = write(folder / name, attributed)
        describe_cloud(folder / "cloud.json", attributed, name, n_written)
    of_all = "" if n_written == len(cloud) else f" of {len(cloud)}"
    return (
        f"{name}: {counted(n_written, 'point')}{of_all} coloured by {colouring}, cloud of {address}"
    )


export_laz = partial(export_cloud, "cloud.laz", write_laz)
export_copc = partial(export_cloud, "cloud.copc.laz", write_copc)
export_ply = partial(export_cloud, "cloud.ply", write_ply)
export_e57 = partial(export_cloud, "cloud.e57", write_e57)


def _makers_of_cameras(cells: Any) -> dict[str, Any]:
    return {
        address: cell
        for address, cell in cells.items()
        if any(output.type_name == "cameras" for output in cell.outputs.values())
    }


def oriented_photos(
    run: Run, cells: Any, chosen: Choices
) -> tuple[tuple[Photo, ViewingCamera], ...]:
    """Return the oriented photos with their cameras, according to the last orientation."""
    makers = _makers_of_cameras(cells)
    if not makers:
        return ()
    address, cell = list(makers.items())[-1]
    taken = [item.digest for item in cell.inputs.values() if item.type_name == "photos"]
    cameras = last_product(run, {address: cell}, Cameras, chosen.store)
    if not taken or cameras is None:
        return ()
    photos = product_of(run, taken[0], Photos, chosen.store)
    known = {camera.photo: camera for camera in cameras.cameras if camera.status == "ok"}
    return tuple(
        (photo, known[photo.name].viewing()) for photo in photos.photos if photo.name in known
    )


def _photo_colours(
    cloud: PointCloud, oriented: Sequence[tuple[Photo, ViewingCamera]], scratch: Path
) -> PointColours:
    """Compute colours in memory-mapped files, so that the colours do not occupy memory."""
    n_points = len(cloud)

    def mapped(name: str, kind: type[np.generic], *more: int) -> NDArray[Any]:
        return np.memmap(scratch / name, dtype=kind, mode="w+", shape=(n_points, *more))

    photo = mapped("photo", np.int16)
    photo[:] = -1
    rgb = mapped("rgb", np.uint8, 3)
    rgb[:] = UNSEEN_GREY
    colours = PointColours(rgb=rgb, best=mapped("best", np.float32), photo=photo)
    colour_points(cloud, oriented, colours)
    return colours


def _wall(walls: Walls | None, number: int | None) -> tuple[Slab | None, int]:
    if number is None:
        return None, -1
    slabs: dict[int, Slab] = {}
    if walls is not None:
        slabs = {wall.plane_index: walls.slab(at) for at, wall in enumerate(walls.walls)}
    return wanted_wall(number, slabs, "the run", "has"), number


def _box(text: str | None) -> NDArray[np.float64] | None:
    if text is None:
        return None
    values = numbers_of(text, 6, "--box must be six numbers in metres, X,Y,Z of two corners,")
    return np.sort(np.array(values).reshape(2, 3), axis=0)


def common_crs_wkt(walls: Walls | None) -> str:
    """Return the coordinate system of the cloud, which the parameter `crs` of `raster.grid` sets.

    The result is WKT; empty if the system is unknown.
    """
    if walls is None:
        return ""
    known = {epsg_of(wall.frame.map_crs) for wall in walls.walls} - {None}
    return "".join(epsg_wkt(code) for code in known if code) if len(known) == 1 else ""
