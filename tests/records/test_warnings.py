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


def test_parameters_are_named_as_they_are_set() -> None:
    said = (
        "raise gsd_m or recover_gap_cells: 3 cells",
        "`margin_m` of raster.grid adds them, view_from of read.scan does not",
        "unit of read.checkpoints and n_photos are left as they are",
    )
    wall = replace(
        cell("wall", params={"gsd_m": 0.01, "margin_m": 0.0, "recover_gap_cells": 3}),
        method="raster.grid",
    )
    warned = replace(wall, warnings=said)
    cloud = replace(cell("cloud", params={"view_from": None}), method="read.scan")
    assert [text for _, text in standing_warnings([cloud, warned])] == [
        "raise wall.gsd_m or wall.recover_gap_cells: 3 cells",
        "`wall.margin_m` adds them, cloud.view_from does not",
        said[2],
    ]
    # Of two steps of a method nobody knows which is meant.
    two = [cloud, replace(cloud, address="other", step="other"), warned]
    assert "view_from of read.scan" in standing_warnings(two)[1][1]
