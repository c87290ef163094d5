"""Which column of a text scan is what: by the user's words, by a header, by their number."""

from __future__ import annotations

import numpy as np
import pytest

from orthoflow.errors import InputError
from orthoflow.files.points.columns import (
    Columns,
    columns_of_count,
    columns_of_header,
    columns_of_text,
    meaning_of,
    point_block,
)


@pytest.mark.parametrize(
    ("name", "meaning"),
    [
        ("X", "x"),
        ("//X", "x"),
        ("X[m]", "x"),
        ("Easting (m)", "x"),
        ("Scalar field #1", "intensity"),
        ("Scalar_Intensity", "intensity"),
        ("Rf", "r"),
        ("diffuse_blue", "b"),
        ("row index", "row"),
        ("Normal_X", "_"),
        ("", "_"),
        ("x" + " " * 199, "x"),
        ("x" + " " * 200, "_"),
    ],
)
def test_names_mean_what_programs_mean_by_them(name: str, meaning: str) -> None:
    assert meaning_of(name) == meaning


@pytest.mark.parametrize(
    ("names", "used", "positions"),
    [
        ("z y x", ("x", "y", "z"), (2, 1, 0)),
        ("x y z b g r", ("x", "y", "z", "r", "g", "b"), (0, 1, 2, 5, 4, 3)),
        # Two colours are none, nor is a row without its column.
        ("x y z r g", ("x", "y", "z"), (0, 1, 2)),
        ("row x y z intensity", ("x", "y", "z", "intensity"), (1, 2, 3, 4)),
        ("column row x y z", ("x", "y", "z", "row", "column"), (2, 3, 4, 1, 0)),
        ("x _ y _ z", ("x", "y", "z"), (0, 2, 4)),
    ],
)
def test_columns_are_used_where_all_that_belongs_to_them_is_there(
    names: str, used: tuple[str, ...], positions: tuple[int, ...]
) -> None:
    columns = columns_of_text(names)
    assert (columns.used, columns.positions, columns.rule) == (used, positions, "parameter")


def test_columns_are_found_among_those_used_or_not_at_all() -> None:
    columns = columns_of_text("x, y, z, intensity, r, g, b")
    assert columns.index_of(["r", "g", "b"]) == [3, 4, 5]
    assert columns.index_of(["intensity"]) == [6]
    assert columns.index_of(["row", "column"]) == []
    assert columns.index_of(["r", "row"]) == []


@pytest.mark.parametrize("text", ["x y", "x y z x", "x y z red", "", "x y z r r", "x _ _"])
def test_columns_that_make_no_points_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="columns must name x, y and z once each"):
        columns_of_text(text)


def test_a_header_names_columns_and_the_first_of_two_counts() -> None:
    columns = columns_of_header(["I", "X", "Y", "Z", "Intensity", "time"])
    assert columns == Columns(names=("intensity", "x", "y", "z", "_", "_"), rule="header")
    assert columns_of_header(["X", "Y", "Intensity"]) is None


COLOURED = [10.0, 20.0, 255.0]
MEASURED = [0.25]


@pytest.mark.parametrize(
    ("samples", "is_pts", "names"),
    [
        ([[1, 2, 3]], False, "x y z"),
        ([[1, 2, 3, 4]], False, "x y z intensity"),
        ([[1, 2, 3, 4, 5, 6]], True, "x y z r g b"),
        ([[1, 2, 3, *COLOURED, *MEASURED]], False, "x y z r g b intensity"),
        ([[1, 2, 3, *MEASURED, *COLOURED]], False, "x y z intensity r g b"),
        # Both could be colours: only a PTS file says which.
        ([[1, 2, 3, 0, 10, 20, 255]], True, "x y z intensity r g b"),
        ([[1, 2, 3, -5, 0, 1, 255]], False, "x y z intensity r g b"),
        ([[1, 2, 3, 0, 1, 255, 256]], False, "x y z r g b intensity"),
        ([[1, 2, 3, 9, 9, 9, 9], [1, 2, 3, 300, 9, 9, 9]], False, "x y z intensity r g b"),
    ],
)
def test_columns_are_told_by_their_number_and_what_is_in_them(
    samples: list[list[float]], is_pts: bool, names: str
) -> None:
    columns = columns_of_count("a.txt", samples, is_pts=is_pts)
    assert columns == Columns(names=tuple(names.split()), rule="count")


@pytest.mark.parametrize(
    ("sample", "is_pts"),
    [
        ([1.0, 2.0], False),
        ([1.0] * 5, False),
        ([1.0] * 8, True),
        ([1.0] * 7, False),
        ([1.0, 2.0, 3.0, 0.5, 300.0, 0.5, 1.0], True),
    ],
)
def test_columns_that_can_mean_several_things_are_asked_about(
    sample: list[float], is_pts: bool
) -> None:
    with pytest.raises(InputError, match=rf"a\.txt has {len(sample)} columns and no header"):
        columns_of_count("a.txt", [sample], is_pts=is_pts)


def test_a_table_is_sorted_into_a_block() -> None:
    columns = columns_of_text("x y z intensity r g b row column")
    table = np.array([[1, 2, 3, 10, 20, 30, 0.5, 7, 8], [4, 5, 6, 11, 21, 31, 0.25, np.nan, 9]])
    block = point_block(table, columns)
    np.testing.assert_array_equal(block.points, [[1, 2, 3], [4, 5, 6]])
    assert block.intensity is not None
    assert block.rgb is not None
    assert block.row is not None
    assert block.column is not None
    # `used` has colours before the intensity.
    np.testing.assert_array_equal(block.rgb, [[10, 20, 30], [11, 21, 31]])
    assert block.intensity.tolist() == [0.5, 0.25]
    assert (block.row.tolist(), block.column.tolist()) == ([7, 0], [8, 9])
    assert (block.n_read, block.scan) == (2, 0)
    bare = point_block(table[:, :3], columns_of_text("x y z"))
    assert (bare.intensity, bare.rgb, bare.row, bare.column) == (None, None, None, None)


def test_columns_are_found_among_those_that_are_used() -> None:
    columns = Columns(names=("x", "y", "z", "row"), rule="")
    assert columns.used == ("x", "y", "z")
    assert columns.index_of(("z", "x", "y")) == [2, 0, 1]
    assert columns.index_of(("y",)) == [1]
    assert columns.index_of(("x", "row")) == []
