"""Orient photos that are rendered from a real scan's colours on the scan's intensity.

    python benchmarks/real_gaps.py SCAN --gsd-m 0.006 --ranks 0
    python benchmarks/real_gaps.py FOLDER/T1.1.txt --paper --gsd-m 0.0013

The colours and the intensity of a scan show the same points, so the true poses are known. Each wall
is flattened, and five photos are rendered from its colours at angles of up to 25 degrees. They are
processed as in `photos-on-scan.yaml`, with EXIF data: `match.sift`, a bundle adjustment with
relaxed gates, `match.guided`, and a bundle adjustment. Void parts of the wall are grey in the
photos. `wall` is the error per coordinate on the wall over the area that a photo shows, in cells;
`stated` is the expected error of the pose.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from orientation_truth import ROUGHLY, context, orient, rematched, sifted
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.plane.given import GivenPlane
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.read.scan import ReadScan
from scan_targets import paper_plane

from orthoflow.errors import MethodError
from orthoflow.files.images import encode_png
from orthoflow.geometry.cameras import ViewingCamera, looking_at, to_opencv
from orthoflow.products import Camera, InputFiles, Photo, Photos, Planes, PointCloud, Wall, Walls

_SIZE_PX = (1200, 900)
_FOCAL_PX = 1100.0
# Angles to the side, upwards and about the axis, in degrees.
_VIEWS = (
    (0.0, 5.0, 1.0),
    (-25.0, 0.0, -3.0),
    (20.0, 8.0, 2.0),
    (-10.0, -8.0, 4.0),
    (12.0, 0.0, 0.0),
)
_NOISE_GREY = 2.0
_CELLS_LEAST = 400


def flat(wall: Wall) -> Wall:
    """Return a wall without relief, so that its colours can be rendered exactly."""
    depth = np.where(np.isfinite(wall.depth_m), np.float32(0.0), np.float32(np.nan))
    return replace(wall, depth_m=depth)


def cameras_before(wall: Wall) -> list[ViewingCamera]:
    """Return cameras that show most of the measured part of a wall."""
    frame = wall.frame
    rows, columns = np.nonzero(np.isfinite(wall.depth_m))
    low, high = np.percentile(np.column_stack([columns, rows]), (2.0, 98.0), axis=0)
    middle = frame.world_from_wall(0.5 * (low + high)[None])[0]
    ahead_m = 1.1 * frame.gsd_m * float((high - low).max()) * _FOCAL_PX / _SIZE_PX[0]
    up = -frame.v_world
    made = []
    for aside, above, roll in np.radians(_VIEWS):
        away = (
            math.cos(aside) * math.cos(above) * frame.normal_world
            + math.sin(aside) * frame.u_world
            + math.sin(above) * up
        )
        centre = middle + ahead_m * away / np.linalg.norm(away)
        turn = np.array(
            [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]]
        )
        rotation = turn @ looking_at(centre, middle, up)
        made.append(
            ViewingCamera(
                width=_SIZE_PX[0],
                height=_SIZE_PX[1],
                fx=_FOCAL_PX,
                fy=_FOCAL_PX,
                cx=0.5 * _SIZE_PX[0],
                cy=0.5 * _SIZE_PX[1],
                distortion=np.zeros(5),
                rotation=rotation,
                translation=-rotation @ centre,
            )
        )
    return made


def photo_of(wall: Wall, camera: ViewingCamera, name: str) -> Photo:
    """Render the colours of a flat wall as seen by a camera."""
    import cv2

    if wall.rgb is None or wall.rgb_mask is None:
        raise SystemExit("the scan has no colours: nothing stands for its photos")
    cells, known = landed(wall, camera, whole_photo(1))
    shape = (camera.height, camera.width)
    maps = [to_opencv(cells[:, k]).reshape(shape).astype(np.float32) for k in range(2)]
    grey = np.where(wall.rgb_mask[:, :, None] > 0, wall.rgb, np.uint8(128))
    seen = np.asarray(cv2.remap(grey, *maps, cv2.INTER_LINEAR, borderValue=(128, 128, 128)))
    seen = np.where(known.reshape(shape)[:, :, None], seen, 128).astype(np.float32)
    seen += np.random.default_rng(len(name)).normal(0.0, _NOISE_GREY, seen.shape)
    encoded = encode_png(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
    return Photo(
        name=name,
        encoded=encoded,
        width=camera.width,
        height=camera.height,
        exif_focal_px=1.03 * camera.fx,
    )


def whole_photo(step: int) -> NDArray[np.float64]:
    """Return every step-th pixel (n, 2) in both directions."""
    across, down = (np.arange(0, side, step) + 0.5 for side in _SIZE_PX)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def landed(
    wall: Wall, camera: ViewingCamera, pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the cells (n, 2) of a flat wall that pixels show, and a mask of those in front."""
    frame = wall.frame
    rays = camera.rays_world(pixels)
    towards = camera.centre_world - frame.origin_world
    with np.errstate(divide="ignore"):
        along = -(towards @ frame.normal_world) / (rays @ frame.normal_world)
    points = towards + along[:, None] * rays
    cells = np.column_stack([points @ frame.u_world, points @ frame.v_world]) / frame.gsd_m
    return cells, along > 0.0


def error_cells(wall: Wall, truth: ViewingCamera, found: ViewingCamera) -> float:
    """Return the RMS error per coordinate on the wall, over the measured cells in a photo."""
    pixels = whole_photo(20)
    cells, known = landed(wall, truth, pixels)
    inside = known & ((cells >= 0) & (cells < wall.frame.shape[::-1])).all(axis=1)
    rows, columns = cells[inside].astype(np.intp).T[::-1]
    inside[np.flatnonzero(inside)[~np.isfinite(wall.depth_m[rows, columns])]] = False
    off = landed(wall, found, pixels[inside])[0] - cells[inside]
    return float(np.sqrt(np.mean(off**2)))


def oriented(photos: Photos, walls: Walls, structure: str) -> Sequence[Camera]:
    """Return the cameras found by the shipped workflow."""
    first = orient(
        OrientColmapBundle, sifted(photos, walls, structure=structure), photos, **ROUGHLY
    )
    try:
        again = rematched("guided", photos, walls, first)
    except MethodError:
        return first.cameras
    return orient(OrientColmapBundle, again, photos).cameras


def walls_in(cloud: PointCloud) -> Planes:
    return Hough2d().run(Hough2d.In(cloud=cloud), Hough2d.Params(), context(1)).planes


def paper(cloud: PointCloud) -> Planes:
    """Return the plane of a small patch of a target, seen from the origin of its file."""
    normal, offset_m = paper_plane(cloud.points_world(np.arange(len(cloud))))
    params = GivenPlane.Params(normal=tuple(normal.tolist()), offset_m=offset_m)
    return GivenPlane().run(GivenPlane.In(cloud=cloud), params, context(1)).planes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scan", type=Path)
    parser.add_argument("--gsd-m", type=float, required=True, help="cell of the wall")
    parser.add_argument("--ranks", type=int, nargs="+", default=[0], help="planes, largest first")
    parser.add_argument("--paper", action="store_true", help="all points are of one small plane")
    parser.add_argument("--structure", default="confirmed")
    chosen = parser.parse_args()
    files = InputFiles(name="scan", paths=(chosen.scan,))
    cloud = ReadScan().run(ReadScan.In(files=files), ReadScan.Params(), context(1)).cloud
    planes = paper(cloud) if chosen.paper else walls_in(cloud)
    rule = RasterGrid.Params(gsd_m=chosen.gsd_m, ranks=tuple(chosen.ranks))
    walls = RasterGrid().run(RasterGrid.In(cloud=cloud, planes=planes), rule, context(1)).walls
    for wall in map(flat, walls.walls):
        known = np.isfinite(wall.depth_m)
        if wall.intensity is None or wall.rgb is None or known.sum() < _CELLS_LEAST:
            print(f"{wall.name}: shows too little")
            continue
        both = known & np.isfinite(wall.intensity)
        grey = wall.rgb[both].astype(np.float64) @ (0.299, 0.587, 0.114)
        alike = float(np.corrcoef(grey, wall.intensity[both])[0, 1])
        shape = " x ".join(map(str, wall.frame.shape))
        print(f"{wall.name}: {shape} cells, {known.mean():.2f} known, correlation {alike:.2f}")
        truths = cameras_before(wall)
        photos = Photos(
            photos=tuple(photo_of(wall, each, f"{k}.png") for k, each in enumerate(truths))
        )
        one = replace(walls, walls=(wall,), buffers_m=())
        for truth, camera in zip(truths, oriented(photos, one, chosen.structure), strict=True):
            if camera.status == "ok":
                off = error_cells(wall, truth, camera.viewing())
                stated = (camera.sigma_wall_m or math.nan) / wall.frame.gsd_m
                print(f"  {camera.photo}: wall {off:.3f} cells, stated {stated:.3f}")
            else:
                print(f"  {camera.photo}: {camera.status}")


if __name__ == "__main__":
    main()
