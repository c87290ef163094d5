"""Files of named points, as programs and people write them, and the whole sentence of a mistake."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoflow.files.publishing import publish_ties
from orthoflow.files.survey_points import (
    MeasuredTie,
    SurveyPoint,
    read_measured_ties,
    read_survey_points,
)
from orthoflow.products import TieRole
from orthoflow.testing.photographed import example_ties
from tests import samples


def read(folder: Path, text: str | bytes) -> tuple[SurveyPoint, ...]:
    path = folder / "p.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_survey_points(path)


@pytest.mark.parametrize("mark", [",", ";", "\t"], ids=["comma", "semicolon", "tab"])
def test_all_columns_are_read_in_any_order(tmp_path: Path, mark: str) -> None:
    lines = ["# a total station's", "", "Name,Class,x,Y,z,wall,v_px,u_px"]
    lines += ["P1,flat,634512.3475,-2,1e-3,0,20.25,10.5", " ", "P 2,,4,5,6,,,", "  # the end"]
    lines += ["P3,flat,7,8,9,32000,1,2"]
    text = "\r\n".join(lines)
    first, second, third = read(tmp_path, text.replace(",", mark))
    plain = SurveyPoint(name="P1", position=(634512.3475, -2.0, 0.001), class_name="flat")
    assert first == replace(plain, wall=0, pixel_wall=(10.5, 20.25))
    assert second == SurveyPoint(name="P 2", position=(4, 5, 6))
    third_is = replace(plain, name="P3", position=(7, 8, 9), wall=32_000, pixel_wall=(2, 1))
    assert third == third_is


@pytest.mark.parametrize(
    ("text", "classes"),
    [
        ("P1,1,2,3\nP2,4,5,6\n", ("", "")),
        ("\ufeffP1;1;2;3;flat\r\nP2;4;5;6;\r\n", ("flat", "")),
        ('Name,X,Y,Z\n"P1",1,2,3\nP2,4,5,6', ("", "")),
        ("P1\t1\t2\t3\tan edge, broken\nP2\t4\t5\t6\t7\n", ("an edge, broken", "7")),
    ],
    ids=["no header", "mark of the byte order and a class", "capitals and quotes", "a comma"],
)
def test_usual_exports_are_read(tmp_path: Path, text: str, classes: tuple[str, str]) -> None:
    assert read(tmp_path, text) == (
        SurveyPoint(name="P1", position=(1, 2, 3), class_name=classes[0]),
        SurveyPoint(name="P2", position=(4, 5, 6), class_name=classes[1]),
    )


def test_points_measured_in_metres_or_by_what_is_shown_there(tmp_path: Path) -> None:
    head = "name,x,y,z,wall,map_x,map_y"
    first, second = read(tmp_path, f"{head}\nA,1,2,3,,634512.5,486215\nB,1,2,3,2,4,-5\n")
    assert (first.place_m, first.wall, first.pixel_wall) == ((634512.5, 486215.0), None, None)
    assert (second.place_m, second.wall) == ((4.0, -5.0), 2)
    head = "name,x,y,z,wall,shown_x,shown_y,shown_z"
    first, second = read(tmp_path, f"{head}\nA,1,2,3,2,1.5,2.5,3.5\nC,1,2,3,,,,\n")
    assert (first.shown_m, first.wall, first.pixel_wall) == ((1.5, 2.5, 3.5), 2, None)
    assert (second.shown_m, second.wall) == (None, None)


def test_ties_know_how_exactly_they_were_measured_where_somebody_says_so(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("photo,u_px,v_px,x,y,z,sigma_px\na.jpg,1.5,2,3,4,5,0.4\nb c.jpg,6,7,8,9,10,\n")
    first, second = read_measured_ties(path)
    assert first == MeasuredTie(
        where="t.csv:2", photo="a.jpg", pixel=(1.5, 2.0), position=(3.0, 4.0, 5.0), sigma_px=0.4
    )
    assert (second.photo, second.sigma_px) == ("b c.jpg", None)


def test_ties_that_orthoflow_wrote_are_read_without_the_rejected(tmp_path: Path) -> None:
    roles = [TieRole.CONTROL, TieRole.REJECTED, TieRole.CHECK]
    ties = samples.taken(example_ties(), slice(3))
    publish_ties(replace(ties, role=np.array(roles, dtype=np.uint8)), tmp_path, "")
    first, last = read_measured_ties(tmp_path / "ties.csv")
    np.testing.assert_allclose(
        [first.position, last.position], ties.points_world[[0, 2]], atol=1e-6
    )
