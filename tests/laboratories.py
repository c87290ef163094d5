"""Distributions for tests of catalog and workflow: real metadata, found like installed ones."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.sdk.hooks import ENTRY_POINT_GROUP
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.model import Workflow

LABORATORY = Path(__file__).parent / "laboratory"
GOOD = """\
orthoflow: 1
name: palace-room
seed: 1729
inputs:
  scan:        {files: data/room.e57}
  photos:      {files: data/photos/*.jpg}
  calibration: {files: data/calibration.yaml, optional: true}
steps:
  cloud:  {use: read.scan,   in: {files: inputs.scan}}
  shots:  {use: read.photos, in: {files: inputs.photos, calibration: inputs.calibration}}
  plane:
    in: {cloud: cloud.cloud}
    variants:
      hough2d: {use: plane.hough2d, params: {cell_m: 0.02}}
      ransac:  {use: plane.ransac,  params: {tolerance_m: 5e-3, iterations: 0o17}, repeat: 10}
  wall:   {use: raster.grid, in: {cloud: cloud.cloud, planes: plane.planes}, params: {gsd_m: 1}}
  ties:   {use: match.sift, in: {photos: shots.photos, walls: wall.walls}}
  first:  {use: orient.pnp, in: {ties: ties.ties, photos: shots.photos}}
  reties: {use: match.guided, in: {photos: shots.photos, walls: wall.walls, cameras: first.cameras}}
  orient:
    in: {ties: reties.ties, photos: shots.photos}
    variants:
      pnp:    {use: orient.pnp}
      bundle: {use: orient.bundle, resources: {cores: 2}, timeout: 30min}
  ortho:
    use: ortho.backward
    in: {walls: wall.walls, photos: shots.photos, cameras: orient.cameras}
  mosaic: {use: mosaic.seams, in: {layers: ortho.layers}}
compare:
  design: product
  baseline: {plane: ransac, orient: bundle}
  exclude: [{plane: ransac, orient: pnp}]
  metrics: [plane.rms_mm, "*.wall_s"]
"""
# Rooms that are scanned or simulated, for datasets; and a swept parameter.
ROOMS = """\
orthoflow: 1
name: rooms
seed: 5
inputs:
  scan: {optional: true}
  photos: {files: shared.jpg}
steps:
  shots: {use: read.photos, in: {files: inputs.photos}}
  cloud: {use: read.scan, in: {files: inputs.scan}}
  room: {use: simulate.room, unless: inputs.scan}
  plane:
    in: {cloud: [cloud.cloud, room.cloud]}
    variants:
      hough2d: {use: plane.hough2d, params: {cell_m: 0.02}}
      ransac: {use: plane.ransac, repeat: 2}
  wall: {use: raster.grid, in: {cloud: [cloud.cloud, room.cloud], planes: plane.planes}}
  ties: {use: match.sift, in: {photos: shots.photos, walls: wall.walls}}
"""
SWEPT = """\
orthoflow: 1
name: swept
inputs:
  scan: {optional: true}
steps:
  room: {use: simulate.room}
  cloud: {use: read.scan, in: {files: inputs.scan}}
  plane:
    use: plane.hough2d
    in: {cloud: room.cloud}
    params: {cell_m: 0.01, tolerance_m: {sweep: [0.02, 0.05, 0.1]}}
  wall: {use: raster.grid, in: {cloud: room.cloud, planes: plane.planes}}
"""


def entry_points_in(*folders: Path) -> list[EntryPoint]:
    """Plugins of the distributions in some folders, and no others."""
    found = metadata.distributions(path=[str(folder) for folder in folders])
    return [
        entry
        for distribution in found
        for entry in distribution.entry_points
        if entry.group == ENTRY_POINT_GROUP
    ]


def write_distribution(
    folder: Path, name: str, sources: Mapping[str, str], *, version: str = "1.0"
) -> Path:
    """Lay a distribution into a folder; its hooks are in the module `<name>_hooks`.

    Args:
        folder: gets the files; put it on sys.path.
        name: of the distribution.
        sources: file name -> Python text.
        version: of the distribution.
    """
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(
        f"[{ENTRY_POINT_GROUP}]\n{name} = {name}_hooks\n", encoding="utf-8"
    )
    for file, text in sources.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text), encoding="utf-8")
    # An earlier test may have loaded hooks of the same name in this process.
    sys.modules.pop(f"{name}_hooks", None)
    return folder


def laboratory_catalog(monkeypatch: pytest.MonkeyPatch, *more: Path) -> Catalog:
    """A catalog of the laboratory's methods, and of distributions in more folders."""
    for folder in (LABORATORY, *more):
        monkeypatch.syspath_prepend(folder)
    return discover_catalog(entry_points_in(LABORATORY, *more))


def with_steps(steps: str, head: str = "inputs: {scan: {files: a.e57}}\n") -> str:
    body = textwrap.indent(textwrap.dedent(steps).strip("\n"), "  ")
    cloud = "cloud: {use: read.scan, in: {files: inputs.scan}}"
    return f"orthoflow: 1\nname: flow\n{head}steps:\n  {cloud}\n{body}\n"


def load(text: str, path: Path, catalog: Catalog, *sets: str) -> Workflow:
    path.write_text(text, encoding="utf-8")
    return load_workflow(path, catalog, sets=sets)
