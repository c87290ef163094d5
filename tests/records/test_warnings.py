"""Warnings that a later step has settled are not told again."""

from __future__ import annotations

from dataclasses import replace

from orthoflow.records.warnings import standing_warnings
from tests.report_runs import cell, given

SIDES = "2 of 3 sides were guessed, unless photos decide later (face.photos): set view_from"


def test_a_warning_is_settled_by_the_method_that_it_names_where_that_was_given_its_product() -> (
    None
):
    found = given("", "a", "planes")
    plane = cell("plane", outputs={"planes": found}, warnings=(SIDES, "the cloud is thick"))
    taken = {"planes": given("plane.planes", "a", "planes")}
    sides = replace(cell("sides", inputs=taken, warnings=("1 stays",)), method="face.photos")
    thick, rest = ("plane", "the cloud is thick"), ("sides", "1 stays")
    assert standing_warnings([plane, sides]) == (thick, rest)
    # Not by another method, nor by one that failed or was given the planes of another cell.
    other = {"planes": given("ransac.planes", "b", "planes")}
    for left in (
        replace(sides, method="raster.grid"),
        replace(sides, status="failed"),
        replace(sides, inputs=other),
    ):
        assert standing_warnings([plane, left]) == (("plane", SIDES), thick, rest)
