"""The plan of photos: where they stand against the walls, and which are missing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.orient.report import residual_rows

from orthoflow.geometry.cameras import looking_at
from orthoflow.products import Camera, Cameras
from orthoflow.report import photo_plans as module
from orthoflow.report.pages import write_page
from orthoflow.report.photo_plans import PhotoRow, photo_plan
from orthoflow.report.pictures import wall_pictures
from tests import samples
from tests.report_runs import HeldRun, camera, cell, compared_run, given


def oriented(run: HeldRun, **changes: Any) -> HeldRun:
    """The run with other orientations."""
    products = {
        place: replace(product, **changes) if isinstance(product, Cameras) else product
        for place, product in run.products.items()
    }
    return replace(run, products=products)


def run_with(folder: Path, *cameras: Camera) -> HeldRun:
    return oriented(compared_run(folder), cameras=cameras)


def ours(run: HeldRun) -> Camera:
    return next(
        product.cameras[0] for product in run.products.values() if isinstance(product, Cameras)
    )


def test_a_photo_stands_before_its_wall_and_looks_at_it(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    # Of two variants the baseline's.
    assert plan.cell == "orient@plane=fine"
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
    one = ours(compared_run(tmp_path))
    odd = replace(one, photo="<b>.jpg")
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
    one = ours(compared_run(tmp_path))
    run = run_with(tmp_path, one, replace(one, photo="b.jpg"))
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert plan.svg.count('class="photo"') == 2
    assert ">b.jpg</text>" not in plan.svg
    assert "<title>b.jpg</title>" in plan.svg


# --- the plan by itself ---

UP = np.array([0.0, 0.0, 1.0])


def test_up_is_that_of_the_planes(tmp_path: Path) -> None:
    run = compared_run(tmp_path)
    np.testing.assert_array_equal(module._up(run), UP)
    up = np.array([0.6, 0.0, 0.8])
    scene = samples.planes(
        normal=np.array([[0.0, 1.0, 0.0]]),
        offset=np.zeros(1),
        corners=np.zeros((1, 4, 3)),
        up=up,
        names=("wall 0",),
    )
    cells = [*run.record.cells, cell("plane", outputs={"planes": given("", "9", "planes")})]
    products = {**run.products, ("plane", "planes"): scene}
    told = replace(run, record=replace(run.record, cells=tuple(cells)), products=products)
    np.testing.assert_array_equal(module._up(told), up)


# Walls of 12 m from west to east and of 4 m from south to north.
WALLS = [
    ("hall", samples.facing_south(0.01, 1200, 300, (100.0, 200.0, 3.0))),
    ("end", samples.facing_east(0.01, 400, 300, (100.0, 196.0, 3.0))),
]


def standing(name: str, x: float, y: float, towards: tuple[float, float]) -> Camera:
    centre = np.array([x, y, 1.5])
    rotation = looking_at(centre, centre + np.array([*towards, 0.0]), UP)
    return Camera(
        photo=name,
        status="ok",
        intrinsics=camera().intrinsics,
        rotation_camera_from_world=rotation,
        translation_camera_from_world=-rotation @ centre,
    )


PHOTOS = [
    standing("a.jpg", 103.0, 194.0, (0.0, 1.0)),
    standing("b.jpg", 109.0, 197.0, (-3.0, 4.0)),
]


def pairs(pattern: str, svg: str) -> np.ndarray:
    return np.array([tuple(map(float, one)) for one in re.findall(pattern, svg)])


def test_walls_and_photos_lie_as_on_a_map() -> None:
    plan = module._Plan.of(UP, PHOTOS, [frame for _, frame in WALLS])
    svg = plan.drawn(PHOTOS, WALLS)
    ((width, height),) = pairs(r'viewBox="0 0 (\d+) (\d+)"', svg)
    # Everything reaches 12 m to the east and 6 m to the north: the longer side decides.
    assert width == 1000.0
    assert height == pytest.approx(0.5 * (width - 140.0) + 140.0, abs=1.0)
    feet = pairs(r'class="photo" cx="([\d.]+)" cy="([\d.]+)"', svg)
    per_m = (feet[1, 0] - feet[0, 0]) / 6.0
    assert per_m == pytest.approx(860.0 / 12.0, abs=0.05)
    # North is up.
    assert feet[1, 1] - feet[0, 1] == pytest.approx(-3.0 * per_m, abs=0.2)
    ways = [
        pairs(r"([\d.]+) ([\d.]+)", way) for way in re.findall(r'class="wall" d="M([^"]+)Z"', svg)
    ]
    for way, (_, frame) in zip(ways, WALLS, strict=True):
        flat = np.asarray(frame.corners_world())[:, :2]
        wanted = feet[0] + per_m * (flat - [103.0, 194.0]) * [1.0, -1.0]
        np.testing.assert_allclose(way, wanted, atol=0.4)
    # Their names stand over the middle of their lower edge, a little above.
    names = re.findall(r'class="wall-name" x="([\d.]+)" y="([\d.]+)"[^>]*>(\w+)<', svg)
    assert [name for *_, name in names] == ["hall", "end"]
    for way, (x, y, _) in zip(ways, names, strict=True):
        middle = 0.5 * (way.min(axis=0) + way.max(axis=0))
        assert float(x) == pytest.approx(middle[0], abs=0.2)
        assert 4.0 < middle[1] - float(y) < 16.0
    # Strokes point where photos look, alike long.
    looks = pairs(r'class="look" d="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)"', svg)
    np.testing.assert_allclose(looks[:, :2], feet)
    ways_of = looks[:, 2:] - looks[:, :2]
    lengths = np.linalg.norm(ways_of, axis=1)
    assert 20.0 < lengths[0] < 80.0
    np.testing.assert_allclose(lengths, lengths[0], atol=0.15)
    np.testing.assert_allclose(ways_of / lengths[0], [[0.0, -1.0], [-0.6, -0.8]], atol=0.005)


def test_names_of_walls_back_to_back_stand_below_each_other_and_none_is_cut() -> None:
    twice = [WALLS[0], ("twin", WALLS[0][1])]
    svg = module._Plan.of(UP, PHOTOS, [frame for _, frame in WALLS]).drawn(PHOTOS, twice)
    first, second = pairs(r'class="wall-name" x="([\d.]+)" y="([\d.]+)"', svg)
    assert second[1] - first[1] >= 18.0
    assert second[0] == first[0]
    # The eastmost photo stands at the margin, where its name has no room to the right.
    east = standing("DSC_0000.jpg", 109.0, 197.0, (1.0, 0.0))
    svg = module._Plan.of(UP, [east, *PHOTOS], []).drawn([east, *PHOTOS], [])
    [(x, anchor)] = re.findall(r'<text x="([\d.]+)" y="[\d.]+"([^>]*)>DSC_0000', svg)
    [width] = re.findall(r'viewBox="0 0 (\d+)', svg)
    assert anchor == (' text-anchor="end"' if float(x) + 100.0 > float(width) else "")
    assert 'text-anchor="end"' in anchor


def test_a_bar_is_as_long_as_it_says_and_at_most_a_quarter() -> None:
    plan = module._Plan.of(UP, PHOTOS, [frame for _, frame in WALLS])
    svg = plan.drawn(PHOTOS, WALLS)
    bar = float(re.findall(r'width="([\d.]+)" height="5"', svg)[0])
    (said,) = re.findall(r">(\d+) m</text>", svg)
    assert bar == pytest.approx(plan.scale * float(said), abs=0.06)
    assert 0.1 * plan.size[0] < bar <= 0.25 * plan.size[0]


def test_what_lies_in_a_row_has_room_about_it() -> None:
    line = [standing(f"{k}.jpg", 100.0 + k, 200.0, (0.0, 1.0)) for k in range(5)]
    flat = module._Plan.of(UP, line, [])
    width, height = flat.size
    # Fifteen hundredths of the other side at least.
    assert height == pytest.approx(0.15 * (width - 140.0) + 140.0)
    feet = np.array([flat.at(module._centre(one)[None])[0] for one in line])
    np.testing.assert_allclose(feet[:, 1], 0.5 * height)
    alone = module._Plan.of(UP, line[:1], [])
    np.testing.assert_allclose(alone.at(module._centre(line[0])[None])[0], [500.0, 500.0])


@pytest.mark.parametrize(("apart", "n_names"), [((119.0, 0.0), 1), ((121.0, 0.0), 2)])
def test_names_that_would_lie_on_another_are_left_out(
    apart: tuple[float, float], n_names: int
) -> None:
    plan = module._Plan.of(UP, PHOTOS, [frame for _, frame in WALLS])
    x, y = np.array(apart) / plan.scale
    beside = [PHOTOS[0], standing("c.jpg", 103.0 + x, 194.0 + y, (0.0, 1.0))]
    assert plan.drawn(beside, WALLS).count(".jpg</text>") == n_names
    # Below each other a name is narrow.
    for down, n_below in ((17.0, 1), (19.0, 2)):
        below = [PHOTOS[0], standing("c.jpg", 103.0, 194.0 + down / plan.scale, (0.0, 1.0))]
        assert plan.drawn(below, WALLS).count(".jpg</text>") == n_below


@pytest.mark.parametrize(("n_photos", "n_names"), [(60, 60), (61, 0)])
def test_of_more_than_sixty_photos_only_the_dots_are_drawn(n_photos: int, n_names: int) -> None:
    many = [
        standing(f"{k}.jpg", 20.0 * (k % 6), 10.0 * (k // 6), (0.0, 1.0)) for k in range(n_photos)
    ]
    plan = module._Plan.of(UP, many, [])
    svg = plan.drawn(many, [])
    assert svg.count('class="photo"') == n_photos
    assert svg.count(".jpg</text>") == n_names
    assert f"plan of {n_photos} photos and 0 walls" in svg


def test_maps_are_kept_where_z_is_up_and_walls_lie_across_elsewhere() -> None:
    frame = WALLS[1][1]
    np.testing.assert_array_equal(module._axes(UP, [frame]), np.eye(3)[:, :2])
    # A tenth of a degree is no map.
    tilted = np.array([np.sin(0.002), 0.0, np.cos(0.002)])
    for up, frames in (
        (tilted, [frame]),
        (np.array([0.0, -1.0, 0.0]), [frame]),
        (np.array([0.0, 1.0, 0.0]), []),
        (frame.u_world, [frame]),
        (-UP, [frame]),
    ):
        right, upwards = module._axes(up, frames).T
        np.testing.assert_allclose([right @ right, upwards @ upwards], 1.0)
        np.testing.assert_allclose([right @ up, upwards @ up, right @ upwards], 0.0, atol=1e-12)
        # Seen from above.
        np.testing.assert_allclose(np.cross(right, upwards), up, atol=1e-12)
        along = frames[0].u_world if frames else np.array([1.0, 0.0, 0.0])
        if abs(along @ up) < 0.999:
            assert right @ along == pytest.approx(np.sqrt(1.0 - (along @ up) ** 2))


def test_each_photo_has_a_row_with_its_error_on_the_wall(tmp_path: Path) -> None:
    one = replace(ours(compared_run(tmp_path)), sigma_wall_m=0.0012)
    refused = Camera(photo="gone.jpg", status="too few <ties>")
    run = run_with(tmp_path, one, refused, replace(one, photo="untied.jpg", sigma_wall_m=None))
    check_px, control_px = np.array([[3.0, -4.0]]), np.array([[50.0, 60.0]])
    units = {"px": 1.0, "mm": 2.0}
    check = residual_rows("a.jpg", "check", check_px, units)
    control = residual_rows("a.jpg", "control", control_px, units)
    run = oriented(run, residual_table=(*check, *control))
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    first, missing, untied = plan.rows
    # Of 30 ties a third each is control, check and rejected.
    assert (first.name, first.status, first.n_control, first.n_check) == ("a.jpg", "ok", 10, 10)
    assert first.sigma_wall_mm == pytest.approx(1.2)
    # The mean of both axes, of check ties alone, in millimetres alone.
    assert first.check_mm == pytest.approx(2.0 * np.sqrt((3.0**2 + 4.0**2) / 2))
    assert missing == PhotoRow(name="gone.jpg", status="too few <ties>")
    assert untied == PhotoRow(name="untied.jpg", status="ok", n_control=0, n_check=0)


def test_photos_of_which_only_poses_are_known_have_no_rows(tmp_path: Path) -> None:
    run = oriented(compared_run(tmp_path), ties=None)
    plan = photo_plan(run, list(wall_pictures(run)))
    assert plan is not None
    assert plan.rows == ()


def test_the_page_has_a_table_of_photos(tmp_path: Path) -> None:
    one = replace(ours(compared_run(tmp_path)), sigma_wall_m=0.001_234)
    run = run_with(tmp_path, one, Camera(photo="gone.jpg", status="too few <ties>"))
    write_page(run, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    [table] = re.findall(r'aria-label="photos of orient@plane=fine".*?</table>', page, re.DOTALL)
    rows = re.findall(r"<tr>(.*?)</tr>", table.partition("<tbody>")[2], re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in rows]
    assert [[re.sub("<wbr>", "", cell) for cell in row] for row in cells] == [
        ["a.jpg", "1.23", "-", "10", "10", "ok"],
        ["gone.jpg", "-", "-", "-", "-", "too few &lt;ties&gt;"],
    ]
