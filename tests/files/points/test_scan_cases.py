"""Scan files as they are met in practice, read as a user expects: `tests/scan_cases.py`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.read.scan import ReadScan

from orthoflow.errors import InputError
from orthoflow.products import PointCloud
from tests.long_loops import long_only
from tests.method_runs import Reader
from tests.scan_cases import CASES, Case, Draw


@pytest.mark.parametrize("seed", [0, 1, 2, 3, *long_only(4, 5, 6)])
@pytest.mark.parametrize("name", CASES)
def test_scans_of_other_programs_are_read_right(name: str, seed: int, tmp_path: Path) -> None:
    case = CASES[name](Draw(seed, tmp_path))
    read = Reader(ReadScan, tmp_path)
    if case.refusal:
        with pytest.raises(InputError) as refused:
            read.run(tuple(case.paths), case.params)
        assert "\n" not in str(refused.value)
        for part in case.refusal:
            assert part in str(refused.value)
        return
    cloud = read.run(tuple(case.paths), case.params).cloud
    for part in case.warnings:
        assert part in read.warnings
    assert not any(part in read.warnings for part in case.not_reported)
    (summary,) = [one.text for one in read.ctx.diagnostics if one.code == "scan-summary"]
    assert f" {len(case.scene):,} points; fields read: " in summary
    np.testing.assert_allclose(
        cloud.points_world() - case.shift, case.scene.points, atol=case.atol_m, rtol=0.0
    )
    check_colours(cloud, case)
    check_intensity(cloud, case)
    check_summary(cloud, case, read.metrics)


def check_colours(cloud: PointCloud, case: Case) -> None:
    if cloud.rgb is None or not case.rgb:
        assert (cloud.rgb is None) is not case.rgb
        return
    everywhere = np.ones(len(cloud), dtype=np.bool_)
    has_rgb = everywhere if case.has_rgb is None else case.has_rgb
    found = everywhere if cloud.has_rgb is None else cloud.has_rgb
    np.testing.assert_array_equal(found, has_rgb)
    assert np.abs(cloud.rgb.astype(int) - case.scene.rgb)[has_rgb].max() <= 1


def check_intensity(cloud: PointCloud, case: Case) -> None:
    if cloud.intensity is None or case.intensity == "none":
        assert (cloud.intensity is None) is (case.intensity == "none")
        return
    is_known = np.isfinite(cloud.intensity)
    assert is_known.all() if case.has_intensity is None else (is_known == case.has_intensity).all()
    if case.has_linear is not None:
        is_known &= case.has_linear
    found, right = cloud.intensity[is_known], case.scene.reflectance[is_known]
    if case.intensity == "equal":
        np.testing.assert_allclose(found, right, atol=0.005)
        return
    slope, start = np.polyfit(right, found, 1)
    inside = (found > 0.0) & (found < 1.0)
    assert inside.mean() > 0.9
    assert slope > 0.5
    np.testing.assert_allclose(found[inside], (start + slope * right)[inside], atol=0.03)


def check_summary(cloud: PointCloud, case: Case, metrics: Mapping[str, float]) -> None:
    scans: Any = cloud.source["scans"]
    assert {scan["unit"] for scan in scans} == set(case.unit.split())
    assert {*case.not_used} <= {name for scan in scans for name in scan["fields_not_used"]}
    assert case.has_grid in (None, cloud.row is not None)
    left_out = sum((Counter(scan["left_out"]) for scan in scans), Counter())
    assert left_out == case.left_out
    assert metrics["n_points_left_out"] == left_out.total()
    assert metrics["n_points"] == sum(scan["n_points"] for scan in scans) == len(case.scene)
