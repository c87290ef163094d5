"""A filter of third parties before the planes: labels are compared for the points that are left."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import PathDistribution, entry_points
from pathlib import Path

import numpy as np
import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.plan import RunOptions, plan_run
from orthoflow.engine.results import CellResult
from orthoflow.engine.scheduler import execute
from orthoflow.engine.store import Store
from orthoflow.products import PointCloud
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells

PLUGIN = """
from dataclasses import replace
import numpy as np
from orthoflow.products import PointCloud
from orthoflow.sdk import KindSpec, Method, MethodParams, MethodSpec, Ports, hookimpl

class Thin(Method):
    '''Keep every other point.'''
    id = "filter.thin"
    determinism = "exact"

    class Params(MethodParams):
        '''No choice.'''

    class In(Ports):
        '''A cloud.'''
        cloud: PointCloud

    class Out(Ports):
        '''Less of it.'''
        cloud: PointCloud

    def run(self, inputs, params, ctx):
        '''Thin.'''
        cloud = inputs.cloud
        return self.Out(cloud=self.less(cloud, np.arange(len(cloud)) % 2 == 0))

    def less(self, cloud, keep):
        return cloud.selected(keep)

class All(Thin):
    '''Keep every point.'''
    id = "filter.all"

    def less(self, cloud, keep):
        return cloud

class Careless(Thin):
    '''Keep every other point, and lose which they were.'''
    id = "filter.careless"

    def less(self, cloud, keep):
        return replace(super().less(cloud, keep), point_id=None)

@hookimpl
def orthoflow_kinds():
    ports = {"cloud": "cloud"}
    return [KindSpec(name="filter", summary="thin clouds", inputs=ports, outputs=ports)]

@hookimpl
def orthoflow_methods():
    return [
        MethodSpec(id="filter.thin", target="thinning:Thin", summary="thin"),
        MethodSpec(id="filter.all", target="thinning:All", summary="keep"),
        MethodSpec(id="filter.careless", target="thinning:Careless", summary="thin"),
    ]
"""
WORKFLOW = """
orthoflow: 1
name: filtered
seed: 7
steps:
  room: {use: simulate.room, params: {scan_step_m: 0.05, photo_layout: none}}
  less:
    in: {cloud: room.cloud}
    variants: {all: {use: filter.all}, thin: {use: filter.thin}, careless: {use: filter.careless}}
  plane: {use: plane.hough2d, in: {cloud: less.cloud}}
  check:
    use: inspect.truth
    in: {planes: plane.planes, labels: plane.labels, cloud: less.cloud, truth: room.truth}
compare: {design: product}
"""


@pytest.fixture
def catalog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Catalog]:
    site = tmp_path / "site"
    (about := site / "thinning-1.0.dist-info").mkdir(parents=True)
    (site / "thinning.py").write_text(PLUGIN)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: thinning\nVersion: 1.0\n")
    (about / "RECORD").write_text("thinning.py,,\n")
    (about / "entry_points.txt").write_text("[orthoflow.plugins]\nthinning = thinning\n")
    monkeypatch.syspath_prepend(site)
    (own,) = PathDistribution(about).entry_points
    others = [e for e in entry_points(group="orthoflow.plugins") if e.name == "builtin"]
    yield discover_catalog([*others, own])
    sys.modules.pop("thinning", None)


def test_a_filter_before_the_planes_leaves_an_evaluation(catalog: Catalog, tmp_path: Path) -> None:
    (tmp_path / "filtered.yaml").write_text(WORKFLOW)
    workflow = load_workflow(tmp_path / "filtered.yaml", catalog)
    store = Store(tmp_path / "store")
    options = RunOptions(executor="inline")
    plan = plan_run(expand_cells(workflow, catalog), workflow, catalog, store, options)
    results = execute(plan, tmp_path / "run", store).results
    every, thin, careless = (results[f"check@less={name}"] for name in ("all", "thin", "careless"))
    assert (thin.status, careless.status) == ("ok", "ok"), careless.error_message
    # Whatever is unknown of the points, the planes are judged.
    assert metric(thin, "main_found") == metric(careless, "main_found") == 1.0
    # The filter's loss is not the detector's.
    for score in ("label_recall", "label_precision"):
        assert metric(thin, score) == pytest.approx(metric(every, score), abs=0.1)
    assert codes(every).isdisjoint({"points-left-out-before-labels", "labels-not-compared"})
    assert "points-left-out-before-labels" in codes(thin)
    assert metric(careless, "label_recall") is None
    assert "labels-not-compared" in codes(careless)


def metric(result: CellResult, name: str) -> float | None:
    return next((one.value for one in result.metrics if one.name == name), None)


def codes(result: CellResult) -> set[str]:
    return {one.code for one in result.diagnostics}


def test_points_keep_their_ids_through_several_selections() -> None:
    x, y, z = np.random.default_rng(3).normal(size=(3, 8)).astype(np.float32)
    whole = PointCloud(
        origin=np.array([4e6, 5e6, 0.0]),
        up=np.array([0.0, 0.0, 1.0]),
        x=x,
        y=y,
        z=z,
        intensity=np.linspace(0.0, 1.0, 8, dtype=np.float32),
    )
    places = np.array([5, 1, 3])
    once = whole.selected(places)
    twice = once.selected(np.array([True, False, True]))
    assert twice.point_id is not None
    np.testing.assert_array_equal(twice.point_id, [5, 3])
    np.testing.assert_array_equal(twice.points_world(), whole.points_world(places[[0, 2]]))
    assert twice.intensity is not None
    assert whole.intensity is not None
    np.testing.assert_array_equal(twice.intensity, whole.intensity[[5, 3]])
