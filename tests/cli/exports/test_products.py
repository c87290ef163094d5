"""Which cell and which product of a run an export takes, and what is said of the others."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.cli.exports.products import (
    branch_of,
    last_product,
    make_empty,
    output_of,
    product_of,
    wanted_wall,
)
from orthoflow.errors import ArgumentError
from orthoflow.products import PointLabels
from tests.report_runs import HeldRun, cell, given, record


def run_of(*addresses: str, type_name: str = "labels") -> HeldRun:
    """Cells that give a product each, whose digests are the letters of the alphabet."""
    cells = [
        cell(address, outputs={"out": given("", chr(97 + place), type_name)})
        for place, address in enumerate(addresses)
    ]
    return HeldRun(path=Path("run.h5"), record=record([cell("scan"), *cells]))


def test_the_last_cell_is_taken_and_the_first_five_others_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert output_of(run_of("plane"), "labels", None) == ("plane", "out")
    assert capsys.readouterr().err == ""
    seven = [f"plane@plane=v{k}" for k in range(7)]
    assert output_of(run_of(*seven), "labels", None) == (seven[-1], "out")
    said = capsys.readouterr().err
    assert f"note: the labels of points of {seven[-1]}; --step takes others: " in said
    assert ", ".join(seven[:5]) in said
    assert "and 1 more" in said
    assert output_of(run_of(*seven[:6]), "labels", None)[0] == seven[5]
    assert "more" not in capsys.readouterr().err
    assert output_of(run_of(*seven), "labels", seven[2]) == (seven[2], "out")
    assert capsys.readouterr().err == ""


def test_a_cell_that_gives_nothing_of_the_kind_is_refused() -> None:
    run = run_of("a", "b")
    with pytest.raises(ArgumentError) as caught:
        output_of(run, "labels", "scan")
    assert str(caught.value) == ("the step scan holds no labels of points; those of this run: a, b")
    with pytest.raises(ArgumentError, match=r"^the run r1 has read no cloud$"):
        output_of(run, "cloud", None)
    with pytest.raises(ArgumentError, match="those of this run: none"):
        output_of(run, "cloud", "a")


def test_walls_are_those_of_their_numbers() -> None:
    known: dict[int, Any] = {4: "four", 0: "none"}
    assert wanted_wall(4, known, "the run", "has") == "four"
    assert wanted_wall(0, known, "the run", "has") == "none"
    with pytest.raises(ArgumentError) as caught:
        wanted_wall(1, known, "the run", "has")
    assert str(caught.value) == "--wall 1: the run has no wall 1; it has 4, 0"
    with pytest.raises(ArgumentError, match="it shows none"):
        wanted_wall(1, {}, "mosaic", "shows")


def test_a_branch_is_what_a_cell_has_chosen_as_far_as_others_know_it() -> None:
    run = HeldRun(
        path=Path("run.h5"),
        record=record(
            [
                cell("scan"),
                cell("plane@plane=a"),
                cell("plane@plane=b"),
                cell("plane@plane=a#1"),
                cell("wall@plane=a,wall=x"),
                cell("wall@plane=a,wall=x#1"),
                cell("ortho@plane=a,wall=x,ortho=f"),
                cell("ortho@plane=a,wall=y,ortho=f"),
            ]
        ),
    )
    assert list(branch_of(run, "wall@plane=a,wall=x")) == [
        *("scan", "plane@plane=a", "wall@plane=a,wall=x", "ortho@plane=a,wall=x,ortho=f"),
    ]
    # A repeat goes with what all repeats share.
    assert list(branch_of(run, "plane@plane=a#1")) == [
        *("scan", "plane@plane=a", "plane@plane=a#1"),
        *("wall@plane=a,wall=x", "wall@plane=a,wall=x#1"),
        *("ortho@plane=a,wall=x,ortho=f", "ortho@plane=a,wall=y,ortho=f"),
    ]


def test_the_last_of_some_cells_gives_a_product(tmp_path: Path) -> None:
    run = run_of("a", "b")
    first, second = (PointLabels(plane_index=np.full(3, k, np.int16)) for k in (1, 2))
    payloads = {"a": first.to_payload(), "b": second.to_payload()}
    held: Any = SimpleNamespace(cells=run.cells, payload=lambda address, _port: payloads[address])
    found = last_product(held, run.cells, PointLabels, tmp_path)
    assert found is not None
    assert found.plane_index.tolist() == [2, 2, 2]
    only = {"a": run.cells["a"]}
    assert last_product(held, only, PointLabels, tmp_path).plane_index.tolist() == [1, 1, 1]  # type: ignore[union-attr]
    assert last_product(held, {"scan": run.cells["scan"]}, PointLabels, tmp_path) is None
    with pytest.raises(ArgumentError, match="name its store with --store, or run the workflow"):
        product_of(held, "sha256:" + "f" * 64, PointLabels, tmp_path / "store")


def test_a_folder_is_made_with_those_above_it(tmp_path: Path) -> None:
    make_empty(tmp_path / "a" / "b")
    make_empty(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(ArgumentError, match="file/c cannot be made: Not a directory"):
        make_empty(tmp_path / "file" / "c")
