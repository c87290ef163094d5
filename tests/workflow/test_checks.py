"""What a workflow that is right may still not mean."""

from __future__ import annotations

from pathlib import Path

from orthoflow.catalog.catalog import Catalog
from orthoflow.workflow.checks import lint_workflow
from tests.laboratories import GOOD, load


def test_cells_that_cannot_be_meant_are_told(catalog: Catalog, tmp_path: Path) -> None:
    limits = "which is implausible: cells are 0.0001 to 0.5 m wide"
    for gsd_m, said in (
        ("3", f"wall.gsd_m is 3 m, {limits}; for 3 mm write gsd_m: 0.003"),
        ("5e-6", f"wall.gsd_m is 5e-06 m, {limits}"),
        ("0.003", ""),
        ("0.5", ""),
    ):
        workflow = load(GOOD.replace("{gsd_m: 1}", f"{{gsd_m: {gsd_m}}}"), tmp_path / "a", catalog)
        assert lint_workflow(workflow) == ((said,) if said else ())


def test_inputs_that_nothing_takes_are_told(catalog: Catalog, tmp_path: Path) -> None:
    text = GOOD.replace("{gsd_m: 1}", "{gsd_m: 0.01}")
    more = text.replace("inputs:\n", "inputs:\n  other: {optional: true}\n")
    assert lint_workflow(load(more, tmp_path / "flow.yaml", catalog)) == (
        "no step uses the input other: connect it as inputs.other, or remove it",
    )
    # One that only says whether a step runs is of use.
    asked = more.replace("wall:   {use", "wall:   {unless: inputs.other, use")
    assert lint_workflow(load(asked, tmp_path / "flow.yaml", catalog)) == ()
