"""Compare orthoimages of a simulated room, from photos up to 35 degrees oblique, with the truth.

    python benchmarks/orthoimage_truth.py [--gsd-m 0.003] [--surfaces nearest denoised]

The scan has 2 mm point spacing and 2 mm noise, the six photos have 2 mm pixels, and one wall is
rastered with 3 mm cells and several surface rules. `true` projects the photos with their true
orientations, `estimated` with those estimated on the last surface (sift, bundle, guided, bundle as
in `photos-on-scan.yaml`). `u` and `v` are RMSE over all cells away from depth steps, `step` over
cells within two cells of a depth step, in mm. `far` is the share of cells whose colour comes from a
point more than three cells away; `ghosts` counts cells coloured from free-standing objects in front
of the wall; `surf` comes from `inspect.surf`, in mm. Seconds are CPU time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from orthoflow_plugins.inspect.surf import InspectSurf
from orthoflow_plugins.inspect.truth import InspectTruth
from orthoflow_plugins.match.guided import MatchGuided
from orthoflow_plugins.match.sift import MatchSift
from orthoflow_plugins.mosaic.seams import MosaicSeams
from orthoflow_plugins.orient.bundle import OrientColmapBundle
from orthoflow_plugins.ortho.dsm_backward import DsmBackward
from orthoflow_plugins.plane.hough2d import Hough2d
from orthoflow_plugins.raster.grid import RasterGrid
from orthoflow_plugins.simulate.room import SimulateRoom

from orthoflow.products import Cameras, Inspection, Orthoimages, Photos, Ties, Walls
from orthoflow.sdk import StepContext

# As in the shipped workflows, a first pose only needs to be accurate to a few cells.
ROUGHLY = {
    "min_quadrant_ties": 0,
    "min_hull_ratio": 0.1,
    "max_sigma_wall_cells": 4.0,
    "max_sigma_corner_cells": 8.0,
}
COLUMNS = (
    ("u", "rmse_u_mm", 1.0),
    ("v", "rmse_v_mm", 1.0),
    ("step u", "step_rmse_u_mm", 1.0),
    ("step v", "step_rmse_v_mm", 1.0),
    ("far[%]", "far_source_share", 100.0),
    ("ghosts", "n_ghost_cells", 1.0),
    ("shown[%]", "completeness_seen_by_both", 100.0),
    ("depth", "depth_rmse_mm", 1.0),
)
SURF_COLUMNS = (
    ("surf x", "rmse_x_mm"),
    ("surf y", "rmse_y_mm"),
    ("floor x", "floor_rmse_x_mm"),
    ("floor y", "floor_rmse_y_mm"),
    ("pairs", "n_pairs"),
)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The room and its evaluation."""

    room: SimulateRoom.Out
    seed: int

    def context(self) -> StepContext:
        folder = Path(tempfile.mkdtemp())
        return StepContext(rng=np.random.default_rng(self.seed), cores=2, scratch=folder)

    def walls(self, surface: str, gsd_m: float) -> Walls:
        planes = (
            Hough2d()
            .run(Hough2d.In(cloud=self.room.cloud), Hough2d.Params(), self.context())
            .planes
        )
        params = RasterGrid.Params.model_validate(
            {"gsd_m": gsd_m, "buffer_m": 0.3, "n_walls_max": 1, "surface": surface}
        )
        inputs = RasterGrid.In(cloud=self.room.cloud, planes=planes)
        return RasterGrid().run(inputs, params, self.context()).walls

    def oriented(self, walls: Walls) -> Cameras:
        photos = self.room.photos
        sift, guided = MatchSift(), MatchGuided()
        ties = sift.run(sift.In(photos=photos, walls=walls), sift.Params(), self.context()).ties
        inputs = guided.In(photos=photos, walls=walls, cameras=self._bundle(ties, **ROUGHLY))
        return self._bundle(guided.run(inputs, guided.Params(), self.context()).ties)

    def _bundle(self, ties: Ties, **params: float) -> Cameras:
        inputs = OrientColmapBundle.In(ties=ties, photos=self.room.photos)
        chosen = OrientColmapBundle.Params.model_validate(params)
        return OrientColmapBundle().run(inputs, chosen, self.context()).cameras

    def orthoimages(self, walls: Walls, cameras: Cameras) -> Orthoimages:
        photos: Photos = self.room.photos
        inputs = DsmBackward.In(walls=walls, cloud=self.room.cloud, photos=photos, cameras=cameras)
        layers = DsmBackward().run(inputs, DsmBackward.Params(), self.context()).layers
        join = MosaicSeams()
        return join.run(
            join.In(layers=layers, walls=walls), join.Params(gains="none"), self.context()
        ).orthoimages

    def truth(self, walls: Walls, cameras: Cameras, images: Orthoimages) -> dict[str, float]:
        inputs = InspectTruth.In(
            truth=self.room.truth, orthoimages=images, walls=walls, cameras=cameras
        )
        return numbers(InspectTruth().run(inputs, InspectTruth.Params(), self.context()).inspection)

    def surf(self, walls: Walls, images: Orthoimages) -> dict[str, float]:
        inputs = InspectSurf.In(orthoimages=images, walls=walls)
        return numbers(InspectSurf().run(inputs, InspectSurf.Params(), self.context()).inspection)


def numbers(inspection: Inspection) -> dict[str, float]:
    """Return the findings on the first wall, and those that do not refer to a wall."""
    measured = {finding.name: finding.value for finding in inspection.findings if finding.wall < 0}
    return measured | {
        finding.name: finding.value for finding in inspection.findings if finding.wall == 0
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--surfaces", nargs="+", default=["nearest", "denoised"])
    parser.add_argument("--gsd-m", type=float, default=0.003, help="cell of the wall")
    parser.add_argument("--scan-step-m", type=float, default=0.002)
    parser.add_argument("--noise-m", type=float, default=0.002, help="of the scanner")
    parser.add_argument("--photo-gsd-m", type=float, default=0.002, help="pixel on the wall")
    parser.add_argument("--obliquity-deg", type=float, default=35.0)
    parser.add_argument("--seed", type=int, default=1729)
    chosen = parser.parse_args()
    bench = Bench(room=_room(chosen), seed=chosen.seed)
    names = [name for name, _, _ in COLUMNS] + [name for name, _ in SURF_COLUMNS]
    print(f"{'surface':10s} {'poses':10s} {'raster[s]':>9s} " + " ".join(f"{n:>8s}" for n in names))
    true = bench.room.truth.cameras
    if true is None:
        raise SystemExit("the room has no photos")
    walls, raster_s = {}, {}
    for surface in chosen.surfaces:
        started = time.process_time()
        walls[surface] = bench.walls(surface, chosen.gsd_m)
        raster_s[surface] = time.process_time() - started
    found = bench.oriented(walls[chosen.surfaces[-1]])
    for surface, wall in walls.items():
        for poses, cameras in (("true", true), ("estimated", found)):
            images = bench.orthoimages(wall, cameras)
            measured, surf = bench.truth(wall, cameras, images), bench.surf(wall, images)
            values = [factor * measured.get(key, np.nan) for _, key, factor in COLUMNS]
            values += [surf.get(key, np.nan) for _, key in SURF_COLUMNS]
            row = " ".join(f"{value:8.3f}" for value in values)
            print(f"{surface:10s} {poses:10s} {raster_s[surface]:9.1f} {row}", flush=True)


def _room(chosen: argparse.Namespace) -> SimulateRoom.Out:
    params = SimulateRoom.Params.model_validate(
        {
            "scan_step_m": chosen.scan_step_m,
            "panorama_step_m": 0.012,
            "noise_m": chosen.noise_m,
            "photo_layout": "quick",
            "photo_gsd_m": chosen.photo_gsd_m,
            "photo_obliquity_deg": chosen.obliquity_deg,
        }
    )
    scratch = Path(tempfile.mkdtemp())
    context = StepContext(rng=np.random.default_rng(chosen.seed), cores=2, scratch=scratch)
    room = SimulateRoom().run(SimulateRoom.In(), params, context)
    oblique = ", ".join(f"{taken.obliquity_deg:.0f}" for taken in room.truth.photos)
    print(f"{len(room.cloud) / 1e6:.1f} M points, photos {oblique} deg oblique", flush=True)
    return room


if __name__ == "__main__":
    main()
