"""Measure the memory of exports of a large orthoimage.

`python -m benchmarks.large_exports --side 20000` writes a finished run with a wall of 400 million
cells (cloud-optimised GeoTIFF, layer in the store), exports it in a separate process for each
format, and prints the processor time and the peak memory of that process, with and without
memory-mapped files. `--to sheet` and similar options select formats.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from orthoflow_provenance.document import PublishedFile, RecordedProduct
from orthoflow_provenance.record import write_record

from benchmarks.tiled_orthoimage import GSD_M, large_orthoimage, largest_mib
from orthoflow.cli.program import program
from orthoflow.engine.file_digests import file_sha256
from orthoflow.engine.store import Store
from orthoflow.files.sidecars import placed_raster
from orthoflow.products import Layer, LayerMask, Layers
from tests.report_runs import cell, record

FORMATS = ("sheet", "dxf", "tiles", "stac", "layers")


def write_large_run(folder: Path, side: int) -> None:
    """Write a run with one orthoimage, and store its only layer."""
    run, store = folder / "run", Store(folder / "store")
    published = run / "products" / "mosaic"
    published.mkdir(parents=True)
    path = large_orthoimage(published, side, side)
    frame, _ = placed_raster(path)
    shape = frame.shape
    # Zeros of an empty file suffice, since the content of a layer does not affect how it is read.
    rgb = np.memmap(folder / "rgb", dtype=np.uint8, mode="w+", shape=(*shape, 3))
    mask = np.memmap(folder / "mask", dtype=np.uint8, mode="w+", shape=shape)
    quality = np.memmap(folder / "quality", dtype=np.float32, mode="w+", shape=shape)
    for first in range(0, side, 512):
        mask[first : first + 512] = LayerMask.PAINTED
    layer = Layer(frame=frame, wall=0, source="a.jpg", rgb=rgb, mask=mask, quality=quality)
    layers = Layers(layers=(layer,), names=("wall 0",), plane_indices=(0,))
    with store.in_use():
        digest = store.put_product(layers).digest
    for name in ("rgb", "mask", "quality"):
        (folder / name).unlink()
    outputs = {
        "ortho": {"layers": RecordedProduct(type_name="layers", encoding_version=1, digest=digest)},
        "mosaic": {
            "orthoimages": RecordedProduct(
                type_name="orthoimages", encoding_version=1, digest=f"sha256:{'0' * 64}"
            )
        },
    }
    files = tuple(
        PublishedFile(
            path=file.relative_to(run).as_posix(),
            size_bytes=file.stat().st_size,
            sha256=file_sha256(file),
        )
        for file in sorted(published.iterdir())
    )
    cells = [cell(step, environment="", outputs=given) for step, given in outputs.items()]
    made = record(cells, name="large", published=files, environments=())
    write_record(run / "run.h5", made, lambda _: None)


def own_mib() -> float:
    """Return this process's memory without mapped files, which the system can drop."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (found,) = [line for line in lines if line.startswith("RssAnon")]
    return int(found.split()[1]) / 1024


def watch(peaks: list[float], is_over: threading.Event) -> None:
    """Record the maximum memory, sampled twenty times per second."""
    while not is_over.wait(0.05):
        peaks[0] = max(peaks[0], own_mib())


def export(folder: Path, target: str) -> None:
    """Export in a child process, and print time and memory."""
    peaks, is_over = [own_mib()], threading.Event()
    watcher = threading.Thread(target=watch, args=(peaks, is_over))
    watcher.start()
    try:
        run_export(folder, target, peaks)
    finally:
        is_over.set()
        watcher.join()


def run_export(folder: Path, target: str, peaks: list[float]) -> None:
    """Export, and print the peak memory so far."""
    words = ["export", str(folder / "run"), "--to", target, "-o", str(folder / "out" / target)]
    first = time.process_time()
    try:
        program([*words, "--store", str(folder / "store")], standalone_mode=False)
    except SystemExit as ended:
        if ended.code:
            print(f"{target} ended with {ended.code}", flush=True)
            return
    made = (folder / "out" / target).rglob("*")
    size = sum(file.stat().st_size for file in made if file.is_file())
    print(
        f"{target}: {size / 1e6:.0f} MB, processor {time.process_time() - first:.0f} s, largest "
        f"memory {largest_mib():.0f} MiB, without mapped files {peaks[0]:.0f} MiB",
        flush=True,
    )


def main() -> None:
    """Write the run, then run each export."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=20_000, help="cells of a side")
    parser.add_argument("--to", action="append", choices=FORMATS, help="formats, all of them else")
    given = parser.parse_args()
    apart = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"{given.side**2 / 1e6:g} M cells of {1e3 * GSD_M:g} mm", flush=True)
        steps = [(write_large_run, (folder, given.side))]
        steps += [(export, (folder, target)) for target in given.to or FORMATS]
        for work, arguments in steps:
            worker = apart.Process(target=work, args=arguments)
            worker.start()
            worker.join()


if __name__ == "__main__":
    main()
