"""What a workflow that is right may still not mean."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.model import (
    Reference,
    StepVariant,
    Workflow,
    WorkflowInputSpec,
    WorkflowStep,
)
from tests.laboratories import GOOD, load


@pytest.mark.parametrize(
    ("gsd_m", "said"),
    [
        (
            "3",
            (
                "wall.gsd_m is 3 m, which can hardly be meant: cells are 0.0001 to 0.5 m wide; "
                "3 mm are written gsd_m: 0.003"
            ),
        ),
        (
            "5e-6",
            "wall.gsd_m is 5e-06 m, which can hardly be meant: cells are 0.0001 to 0.5 m wide",
        ),
        ("0.003", ""),
        ("0.5", ""),
    ],
)
def test_cells_that_cannot_be_meant_are_told(
    gsd_m: str, said: str, catalog: Catalog, tmp_path: Path
) -> None:
    text = GOOD.replace("{gsd_m: 1}", f"{{gsd_m: {gsd_m}}}")
    assert lint_workflow(load(text, tmp_path / "flow.yaml", catalog)) == ((said,) if said else ())


@pytest.mark.parametrize("step", ["ties", "colours"])
def test_a_crop_is_doubted_where_photos_are_matched_to_it(step: str) -> None:
    """Who paints a scan's own colours loses nothing by a crop."""
    method = {"ties": "match.sift", "colours": "ortho.pointcloud-direct"}[step]
    wall = StepVariant(name="", method="raster.grid", params={"crop": [0, 0, 1, 1]})
    steps = [
        WorkflowStep(name="wall", variants=(wall,)),
        WorkflowStep(
            name=step,
            variants=(StepVariant(name="", method=method),),
            inputs={"walls": (Reference(source="wall", name="walls"),)},
            unless="cameras",
        ),
    ]
    flow = Workflow(
        name="flow",
        path=Path("flow.yaml"),
        source="",
        seed=1,
        inputs={"cameras": WorkflowInputSpec(name="cameras")},
        steps={one.name: one for one in steps},
    )
    told = lint_workflow(flow)
    assert len(told) == (step == "ties")
    assert all(text.startswith("wall.crop leaves ties less to match photos to: ") for text in told)
    # Who hands cameras on has done what it says.
    given = {"cameras": WorkflowInputSpec(name="cameras", files=("cameras.json",))}
    assert lint_workflow(replace(flow, inputs=given)) == ()


def test_inputs_that_nothing_takes_are_told(catalog: Catalog, tmp_path: Path) -> None:
    text = GOOD.replace("{gsd_m: 1}", "{gsd_m: 0.01}")
    more = text.replace("inputs:\n", "inputs:\n  other: {optional: true}\n")
    assert lint_workflow(load(more, tmp_path / "flow.yaml", catalog)) == (
        "no step takes the input other: wire it as inputs.other, or remove it",
    )
    # One that only says whether a step runs is of use.
    asked = more.replace("wall:   {use", "wall:   {unless: inputs.other, use")
    assert lint_workflow(load(asked, tmp_path / "flow.yaml", catalog)) == ()
