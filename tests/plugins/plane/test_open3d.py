"""The comparators of open3d, and `refit: false`, which they are for."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from orthoflow_plugins.plane import comparators
from orthoflow_plugins.plane.comparators import Open3dPatches, Open3dRansac, load_open3d
from orthoflow_plugins.plane.ransac import Ransac

from orthoflow.errors import PluginError
from orthoflow.geometry import angle_between_deg
from orthoflow.sdk import Method, StepContext
from tests.plane_scenes import ROOM, cloud_of, context, sampled

STATION = np.array([[0.3, -0.2, 0.1]])
COMPARATORS: dict[str, type[Method]] = {"ransac": Open3dRansac, "patches": Open3dPatches}


def detect(method: type[Method], folder: Path, **params: Any) -> tuple[Any, StepContext]:
    ctx = context(folder)
    cloud = cloud_of(sampled()[::2], stations=STATION)
    return method().run(method.In(cloud=cloud), method.Params(**params), ctx), ctx


@pytest.mark.usefixtures("_open3d")
@pytest.mark.parametrize("name", COMPARATORS)
def test_comparators_find_the_large_planes_of_a_room(name: str, tmp_path: Path) -> None:
    out, _ = detect(COMPARATORS[name], tmp_path)
    # open3d's own word: chance decides about small planes, patches need denser ones.
    for truth in (ROOM[0], ROOM[4], ROOM[5]):
        misses = np.abs(out.planes.normal @ np.array(truth.centre) - out.planes.offset)
        parallel = np.abs(out.planes.normal @ truth.normal) > np.cos(np.radians(0.03))
        assert misses[parallel].min(initial=1.0) < 3e-4
    own = out.labels.plane_index[: ROOM[0].n_points // 2]
    assert np.mean(own == np.bincount(own[own >= 0]).argmax()) > 0.97


@pytest.mark.usefixtures("_open3d")
def test_a_constraint_passes_over_what_open3d_finds_first(tmp_path: Path) -> None:
    planes = detect(Open3dRansac, tmp_path, constraint="horizontal")[0].planes
    assert len(planes) >= 2
    assert (np.abs(planes.normal @ planes.up) > 0.99).all()


@pytest.mark.parametrize("thinning", [1, 3])
def test_without_refit_planes_stay_as_the_detector_gave_them(tmp_path: Path, thinning: int) -> None:
    planes = detect(Ransac, tmp_path, refit=False, thinning=thinning)[0].planes
    fitted = detect(Ransac, tmp_path / "fitted", thinning=thinning)[0].planes
    assert len(planes) == len(fitted)
    for k, raw in enumerate(planes.details["raw"]):
        np.testing.assert_allclose(planes.normal[k], raw["normal"], atol=1e-12)
        assert planes.offset[k] == pytest.approx(raw["offset_m"], abs=1e-12)
    front = ROOM[0].normal
    apart = [
        min(angle_between_deg(each.normal[0], sign * front) for sign in (1.0, -1.0))
        for each in (planes, fitted)
    ]
    assert apart[1] < 0.02 < apart[0] < 1.0


def test_a_missing_open3d_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(PluginError, match=r"plane\.x needs open3d, which is not installed: .* pip"):
        load_open3d("plane.x")


def test_an_open3d_that_does_not_load_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> object:
        if name == "open3d":
            raise OSError("libGL.so.1: cannot open shared object file\nmore")
        return SimpleNamespace(get_library_path=lambda: "nowhere.so")

    monkeypatch.setattr(comparators, "import_module", fail)
    with pytest.raises(PluginError, match=r"does not load \(libGL\.so\.1: .* file\): install the"):
        load_open3d("plane.x")


@pytest.mark.parametrize("installed", ["open3d", "open3d-cpu", None])
def test_the_version_is_told_under_whichever_name_it_is_installed(
    installed: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def version(name: str) -> str:
        if name != installed:
            raise PackageNotFoundError(name)
        return "0.19"

    monkeypatch.setattr(comparators, "version", version)
    expected = {"open3d": "0.19" if installed else "none"}
    assert Open3dRansac.tools() == Open3dPatches.tools() == expected
