"""Compare our pose estimation from mostly wrong ties with OpenCV, pycolmap and PoseLib.

    python benchmarks/robust_pose.py [--photos 100] [--ties 600]

Photos show a wall with 12 cm of relief; correct ties have 1.5 px of noise, a given share of the
ties is at random pixels, and the lens is known. `found` counts poses whose centre is within 50 mm
of the truth; `centre` is the RMS error of those that all programs found; `over best` is our error
divided by that of the best other program; `time` is the median per photo, and `over usac` is our
time divided by OpenCV's. Our estimation is the robust search followed by the adjustment and
rejection of `orient.pnp`. The other programs are used as their manuals advise: USAC with MAGSAC and
a Levenberg-Marquardt refinement on the inliers, and LO-RANSAC with refinement. PoseLib is included
if it is installed (`pip install poselib`).
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from orthoflow_plugins.orient import pose
from orthoflow_plugins.orient.pose import OrientParams

from orthoflow.geometry.cameras import ViewingCamera, looking_at, opencv_matrix, to_opencv
from orthoflow.geometry.resection import SeenPoints
from orthoflow.products import Intrinsics, Photo

SIZE_PX: Final = (3000, 2000)
FOCAL_PX: Final = 2900.0
NOISE_PX: Final = 1.5
FOUND_M: Final = 0.05
THRESHOLD_PX: Final = 3.5 * NOISE_PX
LENS: Final = Intrinsics(
    width=SIZE_PX[0], height=SIZE_PX[1], fx=FOCAL_PX, fy=FOCAL_PX, cx=1500.0, cy=1000.0
)


@dataclass(frozen=True, kw_only=True)
class TiedPhoto:
    """The ties of a photo and its true pose."""

    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    centre: NDArray[np.float64]


Solver = Callable[[TiedPhoto], "NDArray[np.float64] | None"]


def tied_photo(seed: int, n_ties: int, wrong_share: float) -> TiedPhoto:
    rng = np.random.default_rng(seed)
    centre = np.array([rng.uniform(-0.6, 0.6), rng.uniform(-3.4, -2.4), rng.uniform(-0.5, 0.5)])
    rotation = looking_at(centre, rng.uniform(-0.2, 0.2, 3) * [1, 0, 1], np.array([0.0, 0, 1]))
    camera = viewer(rotation, centre)
    places = rng.uniform([-2.5, -1.8], [2.5, 1.8], (12 * n_ties, 2))
    depth = 0.12 * (np.floor(places[:, 0] / 0.4) % 3.0 == 0.0)
    points = np.column_stack([places[:, 0], -depth, places[:, 1]])
    pixels = camera.project(points)[:, :2]
    seen = np.flatnonzero(camera.sees(pixels))[:n_ties]
    observed = pixels[seen] + NOISE_PX * rng.normal(size=(len(seen), 2))
    n_wrong = round(wrong_share * len(seen))
    observed[:n_wrong] = rng.uniform([0.0, 0.0], SIZE_PX, (n_wrong, 2))
    return TiedPhoto(pixels=observed, points=points[seen], centre=centre)


def viewer(rotation: NDArray[np.float64], centre: NDArray[np.float64]) -> ViewingCamera:
    return ViewingCamera(
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        fx=FOCAL_PX,
        fy=FOCAL_PX,
        cx=1500.0,
        cy=1000.0,
        distortion=np.zeros(5),
        rotation=rotation,
        translation=-rotation @ centre,
    )


PHOTO: Final = Photo(
    name="a.jpg",
    encoded=b"",
    width=SIZE_PX[0],
    height=SIZE_PX[1],
    intrinsics=LENS,
)


def ours(seen: TiedPhoto) -> NDArray[np.float64] | None:
    n = len(seen.pixels)
    ties = SeenPoints(
        pixels_photo=seen.pixels,
        points_world=seen.points,
        sigma_px=np.full(n, NOISE_PX),
        sigma_m=np.full(n, 1e-5),
    )
    nobody = np.zeros(n, np.bool_)
    tied = pose.TiedPhoto(
        photo=PHOTO, chosen=np.arange(n), seen=ties, is_check=nobody, by_hand=nobody, seed=1
    )
    found = pose.estimate_pose(tied, OrientParams())
    return None if isinstance(found, str) else found.resection.camera.centre_world


def opencv(seen: TiedPhoto) -> NDArray[np.float64] | None:
    params: Any = cv2.UsacParams()
    params.threshold = THRESHOLD_PX
    params.maxIterations = 20_000
    params.confidence = 0.99999
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    pixels, matrix = to_opencv(seen.pixels), opencv_matrix(LENS.posed())
    call: Any = cv2.solvePnPRansac
    ok, _, turn, shift, inliers = call(seen.points, pixels, matrix.copy(), None, params=params)
    if not ok or inliers is None:
        return None
    chosen = inliers.ravel()
    refine: Any = cv2.solvePnPRefineLM
    turn, shift = refine(seen.points[chosen], pixels[chosen], matrix, None, turn, shift)
    rotation = cv2.Rodrigues(turn)[0]
    return np.asarray(-rotation.T @ shift.ravel())


def colmap(seen: TiedPhoto) -> NDArray[np.float64] | None:
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=SIZE_PX[0],
        height=SIZE_PX[1],
        params=[FOCAL_PX, FOCAL_PX, 1500.0, 1000.0],
    )
    options: Any = {
        "ransac": {
            "max_error": THRESHOLD_PX,
            "confidence": 0.99999,
            "max_num_trials": 20_000,
            "random_seed": 1,
        }
    }
    found: Any = pycolmap.estimate_and_refine_absolute_pose(
        seen.pixels, seen.points, camera, options
    )
    if found is None:
        return None
    matrix = found["cam_from_world"].matrix()
    return np.asarray(-matrix[:, :3].T @ matrix[:, 3])


def poselib(seen: TiedPhoto) -> NDArray[np.float64] | None:
    library: Any = importlib.import_module("poselib")
    camera = {
        "model": "PINHOLE",
        "width": SIZE_PX[0],
        "height": SIZE_PX[1],
        "params": [FOCAL_PX, FOCAL_PX, 1500.0, 1000.0],
    }
    rule = {"max_reproj_error": THRESHOLD_PX, "max_iterations": 20_000, "success_prob": 0.99999}
    pose, _ = library.estimate_absolute_pose(seen.pixels, seen.points, camera, rule, {})
    return np.asarray(-pose.R.T @ pose.t)


def solvers() -> dict[str, Solver]:
    named: dict[str, Solver] = {"ours": ours, "OpenCV USAC": opencv, "pycolmap": colmap}
    if importlib.util.find_spec("poselib"):
        named["PoseLib"] = poselib
    return named


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--ties", type=int, default=600)
    chosen = parser.parse_args()
    named = solvers()
    for wrong_share in (0.3, 0.6, 0.8):
        errors = {name: np.full(chosen.photos, np.inf) for name in named}
        seconds = {name: np.zeros(chosen.photos) for name in named}
        for seed in range(chosen.photos):
            seen = tied_photo(seed, chosen.ties, wrong_share)
            for name, solve in named.items():
                # Solve the first photo twice, so that loading is not measured.
                for _ in range(2 if seed == 0 else 1):
                    started = time.thread_time()
                    centre = solve(seen)
                    seconds[name][seed] = time.thread_time() - started
                if centre is not None:
                    errors[name][seed] = np.linalg.norm(centre - seen.centre)
        report(wrong_share, errors, seconds)


def report(
    wrong_share: float,
    errors: dict[str, NDArray[np.float64]],
    seconds: dict[str, NDArray[np.float64]],
) -> None:
    print(f"\n{100 * wrong_share:.0f} % wrong     found  centre[mm]  time[ms]")
    common = np.all([lengths < FOUND_M for lengths in errors.values()], axis=0)
    rms = {name: float(np.sqrt(np.mean(lengths[common] ** 2))) for name, lengths in errors.items()}
    typical = {name: float(np.median(each)) for name, each in seconds.items()}
    for name, lengths in errors.items():
        n_found = int((lengths < FOUND_M).sum())
        print(
            f"{name:14s} {n_found:4d}/{len(lengths)} {1000 * rms[name]:10.3f} "
            f"{1000 * typical[name]:9.1f}"
        )
    best = min(value for name, value in rms.items() if name != "ours")
    slower = typical["ours"] / typical["OpenCV USAC"]
    print(f"over best {rms['ours'] / best:.3f}, over usac {slower:.2f}")


if __name__ == "__main__":
    main()
