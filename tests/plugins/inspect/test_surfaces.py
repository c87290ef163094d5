"""Curved surfaces that differ from the true ones by known amounts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orthoflow_plugins.inspect.surfaces import InspectSurfaces

from orthoflow.geometry import Cylinder
from orthoflow.products import Surface
from tests import samples
from tests.method_runs import run
from tests.raster_scenes import context, numbers
from tests.recess_scenes import scene


def inspected(folder: Path, *found: Surface) -> dict[str, float]:
    true = samples.surfaces()
    truth = replace(scene()[0], surfaces=replace(true, surfaces=true.surfaces[:1]))
    ctx = context(folder)
    run(InspectSurfaces, ctx, {"truth": truth, "surfaces": replace(true, surfaces=found)})
    return numbers(ctx)


def test_a_vault_has_the_errors_by_which_it_was_changed(tmp_path: Path) -> None:
    vault = samples.surfaces().surfaces[0]
    assert isinstance(vault.shape, Cylinder)
    # The axis points the other way, and its point is elsewhere along it.
    turn = np.array([np.sin(0.01), -np.cos(0.01), 0.0])
    shape = replace(
        vault.shape,
        point_world=vault.shape.point_world + np.array([0.004, 0.0, 0.003]) - turn,
        axis_world=turn,
        radius_m=3.002,
    )
    changed = replace(vault, shape=shape, along_m=(0.0, 2.0))
    far = replace(vault, name="vault 1", shape=replace(vault.shape, radius_m=3.2))
    found = inspected(tmp_path, changed, far)
    assert found["n_true_surfaces"] == found["n_found_surfaces"] == 1
    assert found["n_false_surfaces"] == 1
    assert found["axis_error_max_deg"] == pytest.approx(np.degrees(0.01))
    assert found["axis_offset_max_mm"] == pytest.approx(5.0)
    assert found["radius_error_max_mm"] == pytest.approx(2.0)
    # The standard deviation of the radius is 0.1 mm.
    assert found["radius_error_over_sigma"] == pytest.approx(20.0)
    assert inspected(tmp_path)["n_found_surfaces"] == 0
