"""Compare our descriptor matching with OpenCV's brute force.

    python benchmarks/descriptor_matching.py [--photo 8000] [--wall 8000] [--threads 2] [--repeat 5]

Both return mutual nearest neighbours that pass the ratio test with a limit of 0.85, and their
results agree. OpenCV's version searches for two nearest neighbours in one direction and one in the
other. Times are minima over interleaved runs.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np
from numpy.typing import NDArray

from orthoflow.geometry.key_points import mutual_matches

RATIO = 0.85


def descriptors(n: int, seed: int) -> NDArray[np.float32]:
    """Return integer rows similar to RootSIFT; every tenth row is almost the same in all sets."""
    rng, shared = np.random.default_rng(seed), np.random.default_rng(0)
    raw = rng.gamma(0.6, size=(n, 128))
    common = shared.gamma(0.6, size=(n // 10, 128))
    raw[: len(common)] = common * rng.uniform(0.9, 1.1, common.shape)
    rooted = np.sqrt(raw / raw.sum(axis=1, keepdims=True))
    return np.rint(512.0 * rooted).astype(np.float32)


def ours(photo: NDArray[np.float32], wall: NDArray[np.float32]) -> set[tuple[int, int]]:
    found = mutual_matches(photo, wall, ratio=RATIO)
    return set(zip(found.first.tolist(), found.second.tolist(), strict=True))


def opencv(photo: NDArray[np.float32], wall: NDArray[np.float32]) -> set[tuple[int, int]]:
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = [match.trainIdx for match in matcher.match(wall, photo)]
    return {
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(photo, wall, k=2)
        if best.distance <= RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--photo", type=int, default=8000)
    parser.add_argument("--wall", type=int, default=8000)
    parser.add_argument("--threads", type=int, default=2, help="of OpenCV; ours takes BLAS's")
    parser.add_argument("--repeat", type=int, default=5)
    chosen = parser.parse_args()
    cv2.setNumThreads(chosen.threads)
    photo, wall = descriptors(chosen.photo, 1), descriptors(chosen.wall, 2)
    seconds: dict[str, list[float]] = {"ours": [], "OpenCV": []}
    results = {}
    for _ in range(chosen.repeat):
        for name, match in (("ours", ours), ("OpenCV", opencv)):
            started = time.perf_counter()
            results[name] = match(photo, wall)
            seconds[name].append(time.perf_counter() - started)
    least = {name: min(values) for name, values in seconds.items()}
    for name, value in least.items():
        print(f"{name:12s} {1000 * value:8.0f} ms, {len(results[name])} matches")
    differing = len(results["ours"] ^ results["OpenCV"])
    print(f"{least['OpenCV'] / least['ours']:.1f} times as fast; {differing} matches differ")


if __name__ == "__main__":
    main()
