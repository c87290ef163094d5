"""Count wall cells that are visible in a photo but treated as hidden, and the reverse.

    python benchmarks/hidden_cells.py --rooms 2 --first 551
    # 16 million points a room; and without stations, as in LAZ files:
    python benchmarks/hidden_cells.py --rooms 2 --first 551 --panorama-step-m 0.0022
    python benchmarks/hidden_cells.py --rooms 2 --first 551 --panorama-step-m 0.0022 --no-stations

Rooms are those of `scan_formats.py`: one station, points 4.4 mm apart on the main wall, one stray
point in 250. `ortho.dsm-backward` projects six photos with their true poses onto the wall. `missed`
are cells that a photo shows but that are treated as hidden; `through` are cells inside the photo
that are coloured although an object hides them. Both are determined with the true scene and summed
over all photos.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from orientation_truth import context
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom
from scan_formats import CELLS_M, main_wall_found, scanned_room

from orthoflow.geometry.scene_views import SceneCameras
from orthoflow.products import LayerMask, PointCloud, Walls

# A surface does not hide itself.
_BEFORE_SURFACE_M = 0.01


def counted(walls: Walls, cloud: PointCloud, room: SimulateRoom.Out) -> NDArray[np.int64]:
    """Count cells that are missed, coloured through an obstacle, and inside a photo."""
    cameras = room.truth.cameras
    if cameras is None:
        raise SystemExit("the room has no photos")
    painting = DsmBackward.In(walls=walls, cloud=cloud, photos=room.photos, cameras=cameras)
    layers = DsmBackward().run(painting, DsmBackward.Params(), context(1)).layers
    views, wall = SceneCameras(room.truth.scene, cores=2), walls.walls[0]
    rows, columns = np.nonzero(np.isfinite(wall.depth_m))
    depth_m = wall.depth_m[rows, columns].astype(np.float64)
    points = wall.frame.world_from_wall(np.column_stack([columns, rows]) + 0.5, depth_m)
    totals = np.zeros(3, dtype=np.int64)
    for camera, layer in zip(cameras.cameras, layers.layers, strict=True):
        viewing = camera.viewing()
        ways = viewing.centre_world - points
        before = points + _BEFORE_SURFACE_M * ways / np.linalg.norm(ways, axis=1, keepdims=True)
        is_seen = views.sees(viewing, before - room.truth.scene.origin)
        mask = layer.mask[rows, columns]
        is_hidden, is_painted = mask == LayerMask.OCCLUDED, mask == LayerMask.PAINTED
        counts = (is_hidden & is_seen, is_painted & ~is_seen, is_hidden | is_painted)
        totals += [int(np.count_nonzero(each)) for each in counts]
    return totals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--first", type=int, default=551, help="seed of the first room")
    parser.add_argument("--panorama-step-m", type=float, default=0.03, help="of the other walls")
    parser.add_argument("--no-stations", action="store_true", help="as in a LAZ file")
    chosen = parser.parse_args()
    totals = {gsd_m: np.zeros(3, dtype=np.int64) for gsd_m in CELLS_M}
    for seed in range(chosen.first, chosen.first + chosen.rooms):
        room = scanned_room(seed, chosen.panorama_step_m)
        cloud = room.cloud
        planes, wall = main_wall_found(cloud, room.truth)
        if chosen.no_stations:
            cloud = replace(
                cloud, stations=None, stations_source=None, scan=None, row=None, column=None
            )
        for gsd_m in CELLS_M:
            rule = RasterGrid.Params(gsd_m=gsd_m, buffer_m=0.3, ranks=(wall,))
            rastered = RasterGrid.In(cloud=cloud, planes=planes)
            walls = RasterGrid().run(rastered, rule, context(1)).walls
            totals[gsd_m] += counted(walls, cloud, room)
        print(f"{seed}: {len(cloud) / 1e6:.1f} M points", flush=True)
    print("cells   missed, %  through, %")
    for gsd_m, (missed, through, shown) in totals.items():
        shares = f"{100 * missed / shown:10.1f} {100 * through / shown:10.1f}"
        print(f"{1000 * gsd_m:2.0f} mm   {shares}")


if __name__ == "__main__":
    main()
