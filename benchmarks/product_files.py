"""Measure how fast products as large as a scan are hashed, written and read.

Run with `python benchmarks/product_files.py [POINTS]`; the default is 50 million points. Files are
written to a temporary folder in the working directory.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from orthoflow_provenance.arrays import payload_digest, read_product_file, write_product_file

from orthoflow.products.product import Payload


def timed(what: str, n_bytes: int, work: Callable[[], object]) -> None:
    start = time.perf_counter()
    work()
    seconds = time.perf_counter() - start
    print(f"{what:42} {seconds:7.2f} s {n_bytes / seconds / 1e9:7.2f} GB/s")


def anonymous_mib() -> float:
    """Return the memory that is not backed by files."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024
    return float("nan")


def main() -> None:
    n_points = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000_000
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder_name:
        folder = Path(folder_name)
        for axis in "xyz":
            values = np.random.default_rng(ord(axis)).random(n_points, dtype=np.float32)
            values.tofile(folder / axis)
            del values
        arrays = {axis: np.memmap(folder / axis, np.float32, mode="r") for axis in "xyz"}
        cloud = Payload(
            type_name="cloud", encoding_version=1, metadata={}, arrays=arrays, mapped=True
        )
        n_bytes = sum(array.nbytes for array in arrays.values())
        path = folder / "cloud.h5"
        timed("cloud: digest", n_bytes, lambda: payload_digest(cloud))
        timed("cloud: write, digest, fsync", n_bytes, lambda: write_product_file(path, cloud))
        timed("cloud: map", n_bytes, lambda: read_product_file(path))
        print(f"memory not backed by files: {anonymous_mib():.0f} MiB")
        rows = np.linspace(0, 60, 3000, dtype=np.float32)[:, None]
        noise = np.random.default_rng(0).normal(0, 0.002, (3000, 2000)).astype(np.float32)
        walls = Payload(
            type_name="walls", encoding_version=1, metadata={}, arrays={"depth_m": noise + rows}
        )
        timed("raster: write, digest, fsync", noise.nbytes, lambda: write_product_file(path, walls))
        timed("raster: read", noise.nbytes, lambda: read_product_file(path))


if __name__ == "__main__":
    main()
