"""Measure the share of the true wall that an orthoimage covers, in randomly generated rooms.

    python benchmarks/whole_walls.py --rooms 12 --first 1001
    python benchmarks/whole_walls.py --rooms 12 --first 1001 --rectangle points

With `decoration: drawn`, cornices, pilasters, niches and recessed doors of `simulate.room` are
determined by the seed. The true wall extends from corner to corner and from floor to ceiling. A
cell of it counts if the first surface, seen perpendicular to the wall, is parallel to the wall and
visible from a station. `scanned` is the share of these cells that the raster shows. Of the cells
that are also visible in a photo, `painted` is the share that the orthoimage shows (planes by
`plane.hough2d`, `raster.grid` with default settings and 4 mm cells, true poses of the photos).
`front` and `behind` are the buffer found, next to the buffer that the true relief needs. `lost` is
the location of missing cells: `out`side the raster, beyond the `buf`fer, in a `void` cell of the
raster, or in a cell with a depth.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from orientation_truth import context
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.geometry import frame_over
from orthoflow.geometry.scene_views import SceneCameras, render
from orthoflow.geometry.scenes import SurfaceRole, Viewers
from orthoflow.products import Orthoimage, OrthoMask, SurfaceMask, Truth, Walls

_GSD_M = 0.004
# Random relief projects by at most 0.3 m, and recesses are at most 0.45 m deep; furniture is
# farther in front.
_FRONT_M, _BEHIND_M = 0.5, 0.6
_ALONG_COSINE = 0.99
# Floors and ceilings are rastered, too, but have no true wall.
_UPRIGHT_SINE = 0.5
# A buffer must contain a surface that covers at least this share of the wall.
_RELIEF_LEAST = 1e-3


@dataclass(frozen=True, kw_only=True)
class TrueWall:
    """Cells of the true wall that a station sees.

    Attributes:
        points: (n, 3) world.
        depth_m: (n,) metres in front of the true plane.
        in_photo: (n,) mask of cells that a photo shows, too.
    """

    points: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    in_photo: NDArray[np.bool_]

    def reach_m(self) -> tuple[float, float]:
        """Return the extents of the relief in front of and behind the plane."""
        low, high = np.quantile(self.depth_m, [_RELIEF_LEAST, 1.0 - _RELIEF_LEAST])
        return float(high), float(-low)


def true_wall(truth: Truth, name: str) -> TrueWall:
    index = truth.planes.names.index(name)
    normal = truth.planes.normal[index]
    frame = frame_over(truth.planes.corners[index], normal, gsd_m=_GSD_M)
    viewers = Viewers(
        positions_world=np.unique(truth.stations, axis=0),
        up=truth.planes.up,
        lowest_elevation_deg=truth.lowest_elevation_deg,
        highest_elevation_deg=truth.highest_elevation_deg,
    )
    none = np.zeros(frame.shape, dtype=np.bool_)
    reach = {"front_m": _FRONT_M, "behind_m": _BEHIND_M}
    shown = render(truth.scene, frame, **reach, viewers=viewers, coloured=none, cores=2)
    # The direction of axis b distinguishes the wall's surfaces from the sides of pilasters on
    # adjoining walls.
    along = np.abs(truth.scene.normal @ normal) > _ALONG_COSINE
    along &= np.abs(truth.scene.axis_b @ frame.v_world) > _ALONG_COSINE
    own = along & (truth.scene.role != SurfaceRole.OBJECT)
    # Index -1, where there is no surface, refers to the last rectangle, but such cells are not
    # seen.
    rows, columns = np.nonzero(shown.seen & own[shown.rectangle] & (shown.rectangle >= 0))
    depth_m = shown.depth_m[rows, columns].astype(np.float64)
    points = frame.world_from_wall(np.column_stack([columns, rows]) + 0.5, depth_m)
    in_photo = np.zeros(len(points), dtype=np.bool_)
    cameras = SceneCameras(truth.scene, cores=2)
    for camera in () if truth.cameras is None else truth.cameras.cameras:
        in_photo |= cameras.sees(camera.viewing(), points - truth.scene.origin)
    return TrueWall(points=points, depth_m=depth_m, in_photo=in_photo)


def row(seed: int, truth: Truth, walls: Walls, image: Orthoimage) -> tuple[float, float]:
    """Print the results for a wall; return the shares scanned and covered."""
    raster, slab = walls.walls[image.wall], walls.slab(image.wall)
    normals = truth.planes.normal
    facing = normals @ raster.frame.normal_world
    names = [k for k, name in enumerate(truth.planes.names) if name.endswith(" wall")]
    own = truth.planes.names[max(names, key=lambda k: facing[k])]
    wall = true_wall(truth, own)
    places = raster.frame.wall_from_world(wall.points)
    cells = np.floor(places[:, :2]).astype(np.int64)
    inside = ((cells >= 0) & (cells < [raster.frame.width, raster.frame.height])).all(axis=1)
    columns, rows = cells[inside].T
    scanned, painted = np.zeros((2, len(cells)), dtype=np.bool_)
    scanned[inside] = raster.mask[rows, columns] != SurfaceMask.VOID
    painted[inside] = image.mask[rows, columns] == OrthoMask.PAINTED
    asked = wall.in_photo
    lost = asked & ~painted
    beyond = (places[:, 2] > slab.front_m) | (places[:, 2] < -slab.behind_m)
    causes = {
        "out": lost & ~inside,
        "buf": lost & inside & beyond,
        "void": lost & inside & ~beyond & ~scanned,
        "shown": lost & inside & ~beyond & scanned,
    }
    front_m, behind_m = wall.reach_m()
    shares = float(scanned.mean()), float(painted[asked].mean())
    summary = " ".join(
        f"{name} {100 * cause.sum() / asked.sum():4.1f}" for name, cause in causes.items()
    )
    print(
        f"{seed:5d} {own:13s} {shares[0]:8.3f} {shares[1]:8.3f} "
        f"{slab.front_m:6.2f} /{front_m:5.2f} {slab.behind_m:6.2f} /{behind_m:5.2f}  {summary}",
        flush=True,
    )
    return shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--first", type=int, default=1001, help="seed of the first room")
    parser.add_argument("--layout", default="quick", help="quick: the main wall; variant1: four")
    parser.add_argument("--rectangle", default="room", choices=["room", "points"])
    chosen = parser.parse_args()
    shares = []
    titles = f"{'scanned':>8s} {'painted':>8s} {'front':>13s} {'behind':>13s}"
    print(f"{'seed':5s} {'wall':13s} {titles}  lost, %")
    for seed in range(chosen.first, chosen.first + chosen.rooms):
        params = SimulateRoom.Params.model_validate(
            {
                "scan_step_m": 0.0026,
                "panorama_step_m": 0.012 if chosen.layout == "quick" else 0.004,
                "photo_layout": chosen.layout,
                "photo_gsd_m": 0.004,
                "photo_supersample": 1,
                "decoration": "drawn",
            }
        )
        room = SimulateRoom().run(SimulateRoom.In(), params, context(seed))
        planes = Hough2d().run(Hough2d.In(cloud=room.cloud), Hough2d.Params(), context(1)).planes
        rule = RasterGrid.Params(
            gsd_m=_GSD_M,
            # Include the four walls, and floor and ceiling, which may be larger.
            n_walls_max=1 if chosen.layout == "quick" else 6,
            rectangle=chosen.rectangle,
        )
        walls = (
            RasterGrid().run(RasterGrid.In(cloud=room.cloud, planes=planes), rule, context(1)).walls
        )
        cameras = room.truth.cameras
        if cameras is None:
            raise SystemExit(f"room {seed} has no photos")
        painting = DsmBackward.In(
            walls=walls, cloud=room.cloud, photos=room.photos, cameras=cameras
        )
        layers = DsmBackward().run(painting, DsmBackward.Params(), context(1)).layers
        joined = MosaicSeams().run(
            MosaicSeams.In(layers=layers, walls=walls), MosaicSeams.Params(gains="none"), context(1)
        )
        for image in joined.orthoimages.images:
            normal = walls.walls[image.wall].frame.normal_world
            if abs(float(normal @ room.truth.planes.up)) < _UPRIGHT_SINE:
                shares.append(row(seed, room.truth, walls, image))
    scanned, painted = np.array(shares).T
    print(
        f"\n{len(painted)} walls: scanned {scanned.mean():.3f}, least {scanned.min():.3f}; "
        f"painted {painted.mean():.3f}, least {painted.min():.3f}, "
        f"{np.mean(painted >= 0.97):.0%} of the walls at least 0.970"
    )


if __name__ == "__main__":
    main()
