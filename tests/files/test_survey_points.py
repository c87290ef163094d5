"""Files of named points, as programs and people write them, and the whole sentence of a mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.errors import InputError
from orthoflow.files.survey_points import (
    MeasuredTie,
    SurveyPoint,
    read_measured_ties,
    read_survey_points,
)

SHOWN = "shown_x, shown_y, shown_z"
KNOWN = "known are name, x, y, z, class, wall, u_px, v_px, map_x, map_y, shown_x, shown_y, shown_z"
NAMES_EXPECTED = "expected the names of the columns, name,x,y,z[,class][,wall,u_px,v_px]"
POINTS_EXPECTED = "expected a CSV file of points with the columns name,x,y,z"
WALL = "wall must be the number of a wall, from 0"
ALL = "name,x,y,z,wall,u_px,v_px\n"


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
    assert read(tmp_path, text.replace(",", mark)) == (
        SurveyPoint(
            name="P1",
            position=(634512.3475, -2.0, 0.001),
            class_name="flat",
            wall=0,
            pixel_wall=(10.5, 20.25),
        ),
        SurveyPoint(name="P 2", position=(4, 5, 6), class_name="", wall=None, pixel_wall=None),
        SurveyPoint(
            name="P3", position=(7, 8, 9), class_name="flat", wall=32_000, pixel_wall=(2, 1)
        ),
    )


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


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ("", ["p.csv holds no points: expected name,x,y,z per line"]),
        ("name,x,y,z\n", ["p.csv:1: only the names of the columns, no points"]),
        ("name,x,y,zz\nP,1,2,3", [f"p.csv:1: unknown column zz (did you mean z?); {KNOWN}",
                                  "p.csv:1: the column z is missing"]),
        ("name,y\nP,1", ["p.csv:1: the column x, z is missing"]),
        ("name,x,y,z,x\nP,1,2,3,4", ["p.csv:1: the column x is there 2 times"] * 2),
        ("name,x,y,z,v_px,u_px\nP,1,2,3,4,5",
         ["p.csv:1: wall, u_px, v_px belong together, got only u_px, v_px"]),
        ("P,1,2\n", [f"p.csv:1: {NAMES_EXPECTED}, got 3 values without names"]),
        ("name,x,y,z\nP,1,5,2,5\n",
         ["p.csv:2: expected 4 columns, got 5; write decimal points, not commas"]),
        ("name;x;y;z\nP;1,5;2;c,d\n",
         ["p.csv:2: x must be a number, got 1,5; write a decimal point",
          "p.csv:2: z must be a number, got c,d"]),
        ("name,x,y,z\nP,1,,3\n", ["p.csv:2: y must be a number, got nothing"]),
        ("name,x,y,z\nP,1,nan,3\n", ["p.csv:2: y must be a number, got nan"]),
        ("name,x,y,z\nP,1_0,2,3\n", ["p.csv:2: x must be a number, got 1_0"]),
        ("name,x,y,z\n,1,2,3\n", ["p.csv:2: the name is missing"]),
        ("P,1,2,3\n\nP,4,5,6\n#\nP,7,8,9",
         [f"p.csv:{line}: the name P is there already, in line 1" for line in (3, 5)]),
        (f"{ALL}P,1,2,3,0,5,\n",
         ["p.csv:2: wall, u_px, v_px belong together, got only wall, u_px"]),
        *((f"{ALL}P,1,2,3,{wall},5,6\n", [f"p.csv:2: {WALL}, got {wall}"])
          for wall in ("0.5", "-1", "32001")),
        ("P,1,2,3\n" + "x" * 10_001,
         ["p.csv:2: the line is longer than 10000 letters: this is not such a table"]),
        (b"P,1,2,\xff\n", [f"p.csv is not UTF-8 text: {POINTS_EXPECTED}; save it as UTF-8"]),
        ("name,x,y,z,map_x\nP,1,2,3,4\n",
         ["p.csv:1: map_x, map_y belong together, got only map_x"]),
        ("name,x,y,z,wall,u_px,v_px,map_x,map_y\nP,1,2,3,0,1,2,4,5\n",
         ["p.csv:2: measured twice, as u_px, v_px and as map_x, map_y: leave one of them out"]),
        ("name,x,y,z,shown_x,shown_y,shown_z\nP,1,2,3,4,,6\n",
         ["p.csv:2: shown_x, shown_y, shown_z belong together, got only shown_x, shown_z"]),
    ],
)  # fmt: skip
def test_a_mistake_is_one_sentence_with_its_line(
    tmp_path: Path, text: str | bytes, problems: list[str]
) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert str(caught.value).splitlines() == problems


def test_all_mistakes_come_at_once_and_many_are_counted(tmp_path: Path) -> None:
    for n, more in ((20, []), (21, ["... and 1 more problems"])):
        with pytest.raises(InputError) as caught:
            read(tmp_path, "name,x,y,z\n" + "".join(f"P{k},1,x,3\n" for k in range(n)))
        expected = [f"p.csv:{k}: y must be a number, got x" for k in range(2, 22)]
        assert str(caught.value).splitlines() == expected + more


def test_points_measured_in_metres(tmp_path: Path) -> None:
    points = read(
        tmp_path, "name,x,y,z,map_x,map_y,wall\nA,1,2,3,634512.5,486215,\nB,1,2,3,4,-5,2\n"
    )
    assert [(point.place_m, point.wall, point.pixel_wall) for point in points] == [
        ((634512.5, 486215.0), None, None),
        ((4.0, -5.0), 2, None),
    ]


def test_points_by_what_is_shown_where_they_were_measured(tmp_path: Path) -> None:
    head = "name,x,y,z,wall,shown_x,shown_y,shown_z"
    text = f"{head}\nA,1,2,3,2,1.5,2.5,3.5\nB,1,2,3,,4,5,6\nC,1,2,3,,,,\n"
    assert [(point.shown_m, point.wall, point.pixel_wall) for point in read(tmp_path, text)] == [
        ((1.5, 2.5, 3.5), 2, None),
        ((4.0, 5.0, 6.0), None, None),
        (None, None, None),
    ]


def test_ties_know_how_exactly_they_were_measured_where_somebody_says_so(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("photo,u_px,v_px,x,y,z,sigma_px\na.jpg,1.5,2,3,4,5,0.4\nb c.jpg,6,7,8,9,10,\n")
    first, second = read_measured_ties(path)
    assert first == MeasuredTie(
        where="t.csv:2", photo="a.jpg", pixel=(1.5, 2.0), position=(3.0, 4.0, 5.0), sigma_px=0.4
    )
    assert (second.photo, second.sigma_px) == ("b c.jpg", None)
    path.write_text("photo,u_px,v_px,x,y,z,sigma_px\na.jpg,1,2,3,4,5,-1\n,1,2,3,4,5,1\n")
    with pytest.raises(InputError) as caught:
        read_measured_ties(path)
    assert str(caught.value).splitlines() == [
        "t.csv:2: sigma_px must be positive, got -1",
        "t.csv:3: the name of the photo is missing",
    ]
