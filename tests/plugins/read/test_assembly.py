"""A cloud that grows block by block, against one that is made of all points at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from orthoflow_plugins.read.assembly import CloudAssembly, rounding_m

from orthoflow.errors import InputError
from orthoflow.files.points.scan_file import PointBlock, PointField, Scan, ScanFile
from orthoflow.sdk import StepContext

FIELDS: tuple[PointField, ...] = ("intensity", "rgb", "grid")
HERE = np.array([634_512.25, 486_215.5, 101.75])


def block(seed: int, n: int, *, scan: int = 0, **more: object) -> PointBlock:
    rng = np.random.default_rng(seed)
    plain: dict[str, object] = {
        "points": HERE + rng.uniform(-5.0, 5.0, (n, 3)),
        "scan": scan,
        "n_read": n,
        "intensity": rng.uniform(0.0, 2048.0, n).astype(np.float32),
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "row": rng.integers(0, 3000, n),
        "column": rng.integers(0, 3000, n),
    }
    return PointBlock(**(plain | more))  # type: ignore[arg-type]


def file(
    name: str,
    *blocks: PointBlock,
    fields: Sequence[PointField] = FIELDS,
) -> ScanFile:
    n_scans = max(one.scan for one in blocks) + 1
    return ScanFile(
        name=name,
        format_name="toy",
        n_most=sum(len(one.points) for one in blocks),
        scans=[Scan(fields=frozenset(fields)) for _ in range(n_scans)],
        read=lambda: iter(blocks),
    )


def context(folder: Path, progress: list[tuple[float, str]] | None = None) -> StepContext:
    heard = [] if progress is None else progress
    return StepContext(
        rng=np.random.default_rng(0),
        cores=1,
        scratch=folder,
        listen=lambda event: heard.append((event.fraction, event.text)),
    )


def metres(unit_m: float = 1.0) -> Callable[[Scan], NDArray[np.float64]]:
    return lambda scan: np.full(3, unit_m)


def assembled(
    folder: Path, *files: ScanFile, unit_m: float = 1.0, box_m: NDArray[np.float64] | None = None
) -> CloudAssembly:
    folder.mkdir(exist_ok=True)
    growing = CloudAssembly(context(folder), list(files), metres(unit_m), box_m)
    for one in files:
        growing.add_file(one)
    return growing


def dirtied(clean: PointBlock) -> PointBlock:
    """A block with each kind of point that cannot be used."""
    points = clean.points.copy()
    points[3, 1] = np.nan
    points[5, 2] = np.inf
    points[7, 0] = -2e9
    points[8, 2] = 1e9
    assert clean.intensity is not None
    intensity = clean.intensity.copy()
    intensity[0], intensity[1] = np.nan, np.inf
    return replace(clean, points=points, intensity=intensity)


@pytest.mark.parametrize("unit_m", [1.0, 0.001])
@pytest.mark.parametrize("has_box", [False, True])
def test_what_comes_in_blocks_is_what_there_is(
    tmp_path: Path, unit_m: float, *, has_box: bool
) -> None:
    first, second, third = block(1, 40), dirtied(block(2, 30, scan=1)), block(3, 20)
    blocks = [replace(one, points=one.points / unit_m) for one in (first, second, third)]
    box_m = np.array([HERE - 2.0, HERE + 4.0]) if has_box else None
    found = assembled(
        tmp_path, file("a", *blocks[:2]), file("b", blocks[2]), unit_m=unit_m, box_m=box_m
    )
    points = np.vstack([one.points for one in blocks]) * unit_m
    usable = (np.abs(points) < 1e9).all(axis=1)
    inside = usable.copy()
    if box_m is not None:
        with np.errstate(invalid="ignore"):
            inside &= ((points >= box_m[0]) & (points <= box_m[1])).all(axis=1)
    assert 0 < inside.sum() <= usable.sum() == len(points) - 4
    of_first = np.arange(len(points)) < 40
    own = inside[of_first]
    # Whole metres near the first points that are kept.
    origin = np.floor(np.median(points[of_first][own], axis=0))
    np.testing.assert_array_equal(found.origin, origin)
    assert found.n_points == inside.sum()
    expected = (points[inside] - origin).astype(np.float32)
    np.testing.assert_array_equal(np.column_stack(found.offsets), expected)
    for name in ("row", "column", "intensity"):
        values = np.concatenate([getattr(one, name) for one in blocks])[inside]
        np.testing.assert_array_equal(found.array(name), values)
    np.testing.assert_array_equal(
        found.array("rgb"), np.vstack([one.rgb for one in blocks if one.rgb is not None])[inside]
    )
    scans = np.repeat([0, 1, 2], [40, 30, 20])
    np.testing.assert_array_equal(found.array("scan"), scans[inside])
    for scan, count in enumerate(found.counts):
        mine = scans == scan
        assert (count.n_read, count.n_kept) == (mine.sum(), inside[mine].sum())
        assert count.left_out["outside_box"] == np.count_nonzero(usable[mine] & ~inside[mine])
        np.testing.assert_array_equal(scans[inside][count.start : count.stop], scan)
    assert [count.left_out["not_finite"] for count in found.counts] == [0, 2, 0]
    assert [count.left_out["too_far"] for count in found.counts] == [0, 2, 0]
    assert found.counts[1].first_far_m == pytest.approx(tuple(points[47]))


def test_a_file_without_a_point_that_can_be_used_is_refused_with_its_counts(tmp_path: Path) -> None:
    lost = block(
        1, 4, points=np.full((4, 3), np.nan), n_read=9, left_out={"invalid": 3, "withheld": 2}
    )
    with pytest.raises(InputError) as caught:
        assembled(tmp_path, file("a", lost))
    assert str(caught.value) == (
        "a contains no usable points: of 9, left out are 3 invalid, 2 withheld, 4 not finite; "
        "export it again"
    )


def test_more_points_than_a_header_states_are_refused(tmp_path: Path) -> None:
    short = replace(file("a", block(1, 10), block(2, 10)), n_most=19)
    with pytest.raises(InputError, match=r"^a contains more points than its header declares$"):
        assembled(tmp_path, short)
    exact = replace(short, n_most=20)
    assert assembled(tmp_path / "exact", exact).n_points == 20


# --- how coordinates are rounded ---


@pytest.mark.parametrize("step", [0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 1.0, 100.0, 0.0078125, 8.0])
def test_a_coarse_step_is_found(step: float) -> None:
    rng = np.random.default_rng(7)
    rounded = step * rng.integers(0, 1000, (3000, 3)) + 12.0 * step
    assert rounding_m(rounded, 1.0) == pytest.approx(step)
    if step in (0.005, 0.01, 0.02, 0.05, 0.1, 0.5):
        # In millimetres as well, in which half a metre is the coarsest that is looked for.
        assert rounding_m(1000.0 * rounded, 0.001) == pytest.approx(step)
