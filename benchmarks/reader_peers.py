"""Compare time and memory of our point file readers with those of the formats' libraries.

    python benchmarks/reader_peers.py FOLDER [--points 10000000] [--formats ply las laz e57 pcd xyz]

The library of each format writes a file of points with intensity and colours. A new process reads
the file with the library into arrays of coordinates, intensity and colours. Other processes read it
block by block with `open_scan`, and as a whole cloud with `read.scan`, which also measures its
quality and draws it. The output is the time of the fastest of `--repeats` runs, without imports,
and the anonymous memory. Ratios compare processor times, which other load on the machine hardly
affects.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from orthoflow_plugins.plane.comparators import load_open3d
from plane_streaming import measured

Fields = dict[str, Any]
WAYS = ("library", "reader", "read.scan")


def fields_of(n_points: int) -> Fields:
    """Return points on the walls of a room, rounded to a tenth of a millimetre."""
    rng = np.random.default_rng(1)
    points = np.round(rng.uniform(0.0, 20.0, (n_points, 3)), 4)
    points[np.arange(n_points), np.arange(n_points) % 3] = 20.0
    rgb = rng.integers(0, 256, (n_points, 3), dtype=np.uint8)
    names = ("x", "y", "z", "intensity", "red", "green", "blue")
    values = (*points.T, rng.random(n_points, dtype=np.float32), *rgb.T)
    return dict(zip(names, values, strict=True))


def write_ply(path: Path, fields: Fields) -> None:
    """Write binary PLY with plyfile."""
    from plyfile import PlyData, PlyElement

    table = np.rec.fromarrays(
        [v.astype(np.float32) if v.dtype == np.float64 else v for v in fields.values()],
        names=",".join(fields),
    )
    PlyData([PlyElement.describe(np.asarray(table), "vertex")], byte_order="<").write(str(path))


def read_ply(path: Path) -> list[Any]:
    """Read PLY with plyfile, memory-mapped."""
    from plyfile import PlyData

    data = PlyData.read(str(path), mmap="r")["vertex"].data
    return [data[name].astype(np.float64) for name in "xyz"] + [
        np.array(data["intensity"]),
        np.column_stack([data[name] for name in ("red", "green", "blue")]),
    ]


def write_las(path: Path, fields: Fields) -> None:
    """Write LAS or LAZ with laspy."""
    import laspy

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = (fields[name] for name in "xyz")
    las.intensity = np.rint(65535 * fields["intensity"]).astype(np.uint16)
    for name in ("red", "green", "blue"):
        las[name] = fields[name].astype(np.uint16) * 256
    las.write(str(path))


def read_las(path: Path) -> list[Any]:
    """Read a complete LAS or LAZ file with laspy."""
    import laspy

    las = laspy.read(str(path))
    colours = np.column_stack([las.red, las.green, las.blue])
    return [*(np.asarray(las[name]) for name in "xyz"), np.asarray(las.intensity), colours]


def write_e57(path: Path, fields: Fields) -> None:
    """Write one scan with pye57."""
    import pye57

    names = dict(zip("xyz", ("cartesianX", "cartesianY", "cartesianZ"), strict=True))
    names |= {"intensity": "intensity", "red": "colorRed", "green": "colorGreen"}
    names |= {"blue": "colorBlue"}
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw({names[name]: values for name, values in fields.items()})


def read_e57(path: Path) -> list[Any]:
    """Read a complete E57 file with pye57."""
    import pye57

    with pye57.E57(str(path)) as file:
        scan = file.read_scan_raw(0)
    colours = np.column_stack([scan[name] for name in ("colorRed", "colorGreen", "colorBlue")])
    return [*(scan[f"cartesian{axis}"] for axis in "XYZ"), scan["intensity"], colours]


def write_pcd(path: Path, fields: Fields) -> None:
    """Write binary PCD with open3d, without intensity, which it does not support."""
    open3d = load_open3d("the benchmark")
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.column_stack([fields[a] for a in "xyz"]))
    colours = np.column_stack([fields[name] for name in ("red", "green", "blue")])
    cloud.colors = open3d.utility.Vector3dVector(colours / 255.0)
    open3d.io.write_point_cloud(str(path), cloud)


def read_pcd(path: Path) -> list[Any]:
    """Read a complete PCD file with open3d."""
    cloud = load_open3d("the benchmark").io.read_point_cloud(str(path))
    return [np.asarray(cloud.points), np.asarray(cloud.colors)]


def write_xyz(path: Path, fields: Fields) -> None:
    """Write text with pandas."""
    import pandas as pd

    pd.DataFrame(fields).to_csv(path, sep=" ", index=False, float_format="%.4f")


def read_xyz(path: Path) -> list[Any]:
    """Read a complete text file with pandas."""
    import pandas as pd

    frame = pd.read_csv(path, sep=" ")
    groups = (["x", "y", "z"], ["intensity"], ["red", "green", "blue"])
    return [frame[names].to_numpy() for names in groups]


FORMATS: dict[str, tuple[Callable[[Path, Fields], None], Callable[[Path], list[Any]]]] = {
    "ply": (write_ply, read_ply),
    "las": (write_las, read_las),
    "laz": (write_las, read_las),
    "e57": (write_e57, read_e57),
    "pcd": (write_pcd, read_pcd),
    "xyz": (write_xyz, read_xyz),
}


def read(path: Path, way: str) -> tuple[float, float]:
    """Read a file; return elapsed and processor seconds."""
    import laspy  # noqa: F401 - what imports take is no reader's time
    import pandas as pd  # noqa: F401
    import pye57  # noqa: F401

    load_open3d("the benchmark")
    from orthoflow.files.points import open_scan
    from orthoflow.products import InputFiles
    from orthoflow.sdk import StepContext

    started_s, started_cpu_s = time.perf_counter(), time.process_time()
    if way == "library":
        FORMATS[path.suffix[1:]][1](path)
    elif way == "reader":
        for block in open_scan(path).read():
            del block
    else:
        from orthoflow_plugins.read.scan import ReadScan

        scratch = path.with_suffix(".scratch")
        scratch.mkdir(exist_ok=True)
        ctx = StepContext(rng=np.random.default_rng(0), cores=2, scratch=scratch)
        files = InputFiles(name="scan", paths=(path,))
        ReadScan().run(ReadScan.In(files=files), ReadScan.Params(), ctx)
    return time.perf_counter() - started_s, time.process_time() - started_cpu_s


def main() -> None:
    """Write the files, read each with every method, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--read", nargs=2, metavar=("FILE", "WAY"), help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.read:
        print(json.dumps(read(Path(wanted.read[0]), wanted.read[1])))
        return
    wanted.folder.mkdir(parents=True, exist_ok=True)
    fields = None
    print("format  way         seconds  processor  to library  anonymous MiB")
    for name in wanted.formats:
        path = wanted.folder / f"points_{wanted.points}.{name}"
        if not path.exists():
            fields = fields or fields_of(wanted.points)
            FORMATS[name][0](path, fields)
        least_cpu: dict[str, float] = {}
        for way in wanted.ways:
            command = [sys.executable, __file__, str(wanted.folder), "--read", str(path), way]
            times = [json.loads(subprocess.check_output(command)) for _ in range(wanted.repeats)]
            wall_s, least_cpu[way] = np.min(times, axis=0)
            share = least_cpu[way] / least_cpu.get("library", np.nan)
            memory = measured(command).anonymous_mib
            print(
                f"{name:6s}  {way:10s}  {wall_s:7.2f}  {least_cpu[way]:9.2f}  {share:10.2f}  "
                f"{memory:13.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
