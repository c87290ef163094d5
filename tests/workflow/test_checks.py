"""What a workflow that is right may still not mean."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.document import load_workflow
from tests.laboratories import GOOD, load


def test_cells_that_cannot_be_meant_are_told(catalog: Catalog, tmp_path: Path) -> None:
    limits = "which is implausible: a cell is usually 0.0001 to 0.5 m wide"
    for gsd_m, said in (
        ("3", f"wall.gsd_m is 3 m, {limits}; for 3 mm write gsd_m: 0.003"),
        ("5e-6", f"wall.gsd_m is 5e-06 m, {limits}"),
        ("0.003", ""),
        ("0.5", ""),
    ):
        workflow = load(GOOD.replace("{gsd_m: 1}", f"{{gsd_m: {gsd_m}}}"), tmp_path / "a", catalog)
        assert lint_workflow(workflow) == ((said,) if said else ())


@pytest.mark.parametrize(("recipe", "n"), [("photos-on-scan", 1), ("direct", 0)])
def test_a_crop_is_reported_where_photos_are_matched_to_it(recipe: str, n: int) -> None:
    """A scan's own colours lose nothing by a crop."""
    catalog, sets = discover_catalog(), ["wall.crop=[0, 0, 1, 1]"]
    reported = lint_workflow(load_workflow(recipe, catalog, sets=sets))
    assert len([text for text in reported if text.startswith("wall.crop reduces ")]) == n
    # Cameras from elsewhere need no matches.
    given = ["cameras=cameras.json"] if n else []
    reported = lint_workflow(load_workflow(recipe, catalog, inputs=given, sets=sets))
    assert not [text for text in reported if "crop" in text]


def test_inputs_that_nothing_takes_are_told(catalog: Catalog, tmp_path: Path) -> None:
    text = GOOD.replace("{gsd_m: 1}", "{gsd_m: 0.01}")
    more = text.replace("inputs:\n", "inputs:\n  other: {optional: true}\n")
    assert lint_workflow(load(more, tmp_path / "flow.yaml", catalog)) == (
        "no step uses the input other: connect inputs.other to a step, or remove the input",
    )
    # One that only says whether a step runs is of use.
    asked = more.replace("wall:   {use", "wall:   {unless: inputs.other, use")
    assert lint_workflow(load(asked, tmp_path / "flow.yaml", catalog)) == ()
