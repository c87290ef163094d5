"""Measure the memory of match.sift for one large photo of a wall of 3 million cells.

    python benchmarks/matching_memory.py [--megapixels 24] [--longest-side-px 6000] [--other-wall]

The photo is a perpendicular view of a wall with a random texture, and is matched at the resolution
of the wall's cells. With --other-wall, the photo does not show the wall and is matched at all sizes
up to the full size. The photo is made beforehand, so that the child process only matches. The
output is the peak resident memory of the child process, including Python and all libraries; the
limit for 24 megapixels is 1.5 GB.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from orthoflow_plugins.match.sift import MatchSift

from orthoflow.geometry import WallFrame
from orthoflow.products import Photo, Photos, Wall, Walls
from orthoflow.sdk import StepContext

CELLS = (2120, 1414)
GSD_M = 0.003


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--megapixels", type=float, default=24.0)
    parser.add_argument("--longest-side-px", type=int, default=6000, help="as match.sift takes it")
    parser.add_argument("--other-wall", action="store_true", help="the photo shows no wall")
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.folder is not None:
        match(chosen.folder, chosen.longest_side_px)
        return
    with tempfile.TemporaryDirectory() as folder:
        picture = texture(chosen.megapixels, seed=1)
        cv2.imwrite(f"{folder}/photo.jpg", picture)
        shown = texture(chosen.megapixels, seed=2) if chosen.other_wall else picture
        np.save(f"{folder}/wall.npy", cv2.resize(shown, CELLS, interpolation=cv2.INTER_AREA))
        command = [sys.executable, __file__, "--folder", folder]
        subprocess.run([*command, "--longest-side-px", str(chosen.longest_side_px)], check=True)


def texture(megapixels: float, *, seed: int) -> NDArray[np.uint8]:
    """Return random grey levels with detail of all sizes, in the ratio 3:2."""
    height = round((megapixels * 1e6 / 1.5) ** 0.5)
    rng, total = np.random.default_rng(seed), np.zeros((height, height * 3 // 2), np.float32)
    for step in (3, 8, 24, 80, 240):
        noise = rng.normal(size=(total.shape[0] // step + 2, total.shape[1] // step + 2))
        total += cv2.resize(
            noise.astype(np.float32), total.shape[::-1], interpolation=cv2.INTER_CUBIC
        )
    return np.asarray(np.clip(128.0 + 28.0 * total, 0, 255), dtype=np.uint8)


def match(folder: Path, longest_side_px: int) -> None:
    """Match, and print the time and the peak memory of the process."""
    encoded = (folder / "photo.jpg").read_bytes()
    intensity = np.load(folder / "wall.npy").astype(np.float32)
    height, width = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE).shape
    shape = intensity.shape
    frame = WallFrame(
        origin_world=np.zeros(3),
        u_world=np.array([1.0, 0.0, 0.0]),
        v_world=np.array([0.0, 0.0, -1.0]),
        normal_world=np.array([0.0, -1.0, 0.0]),
        gsd_m=GSD_M,
        width=shape[1],
        height=shape[0],
    )
    wall = Wall(
        frame=frame,
        plane_index=0,
        name="wall 0",
        depth_m=np.zeros(shape, np.float32),
        sigma_m=np.full(shape, 0.001, np.float32),
        count=np.ones(shape, np.uint32),
        mask=np.ones(shape, np.uint8),
        intensity=intensity,
        rgb=None,
        rgb_mask=None,
    )
    inputs = MatchSift.In(
        photos=Photos(photos=(Photo(name="a.jpg", encoded=encoded, width=width, height=height),)),
        walls=Walls(
            walls=(wall,),
            up=np.array([0.0, 0.0, 1.0]),
            intensity_source="laser",
            buffer_front_m=0.1,
            buffer_behind_m=0.1,
        ),
    )
    ctx = StepContext(rng=np.random.default_rng(1), cores=2, scratch=folder)
    started = time.perf_counter()
    params = MatchSift.Params(max_side_px=longest_side_px)
    ties = MatchSift().run(inputs, params, ctx).ties
    seconds = time.perf_counter() - started
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    megapixels = width * height / 1e6
    print(f"{megapixels:.1f} MP, {len(ties.photo)} ties, {seconds:.1f} s, {peak_mb:.0f} MB at most")


if __name__ == "__main__":
    main()
