"""The plan of photos: where they stand against the walls, and which are missing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoflow.products import Camera, Cameras
from orthoflow.report.photo_plans import photo_plan
from orthoflow.report.pictures import wall_pictures
from tests.report_runs import HeldRun, compared_run


def run_with(folder: Path, *cameras: Camera) -> HeldRun:
    run = compared_run(folder)
    products = {
        place: replace(product, cameras=cameras) if isinstance(product, Cameras) else product
        for place, product in run.products.items()
    }
    return replace(run, products=products)


def ours(run: HeldRun) -> Camera:
    return next(
        product.cameras[0] for product in run.products.values() if isinstance(product, Cameras)
    )


def test_a_photo_stands_before_its_wall_and_looks_at_it(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    [(x, y)] = re.findall(r'class="photo" cx="([0-9.]+)" cy="([0-9.]+)"', plan.svg)
    wall = np.array(
        re.findall(r"([0-9.]+) ([0-9.]+)", re.findall(r'wall" d="M([^"]*)Z', plan.svg)[0])
    )
    corners = wall.astype(np.float64)
    # 2 m to the south of a wall of 1.2 m from west to east: below it on the page.
    assert corners[:, 0].min() < float(x) < corners[:, 0].max()
    per_metre = np.ptp(corners[:, 0]) / 1.2
    assert float(y) - corners[:, 1].max() == pytest.approx(2.0 * per_metre, rel=0.02)
    [(y0, y1)] = re.findall(r'class="look" d="M[0-9.]+ ([0-9.]+)L[0-9.]+ ([0-9.]+)"', plan.svg)
    assert float(y1) < float(y0)


def test_refused_photos_are_named_and_names_are_escaped(tmp_path: Path) -> None:
    camera = ours(compared_run(tmp_path))
    odd = replace(camera, photo="<b>.jpg")
    refused = Camera(photo="gone.jpg", status="too few ties")
    run = run_with(tmp_path, odd, refused)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert "1 of 2 photos" in plan.caption
    assert "Not oriented, and so not drawn: gone.jpg." in plan.caption
    assert "&lt;b&gt;.jpg" in plan.svg
    assert "<b>" not in plan.svg


def test_without_an_oriented_photo_there_is_no_plan(tmp_path: Path) -> None:
    run = run_with(tmp_path, Camera(photo="gone.jpg", status="too few ties"))
    assert photo_plan(run, list(wall_pictures(run))) is None


def test_photos_at_one_place_have_one_name(tmp_path: Path) -> None:
    camera = ours(compared_run(tmp_path))
    run = run_with(tmp_path, camera, replace(camera, photo="b.jpg"))
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert plan.svg.count('class="photo"') == 2
    assert ">b.jpg</text>" not in plan.svg
    assert "<title>b.jpg</title>" in plan.svg
