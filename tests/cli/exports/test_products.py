"""Which cell and which product of a run an export takes, and what is said of the others."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.cli.exports.products import (
    last_product,
    make_empty,
    output_of,
    product_of,
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
    seven = [f"plane@plane=v{k}" for k in range(7)]
    assert output_of(run_of(*seven), "labels", seven[2]) == (seven[2], "out")
    assert capsys.readouterr().err == ""
    assert output_of(run_of(*seven), "labels", None) == (seven[-1], "out")
    said = capsys.readouterr().err
    assert f"note: using the labels of points of {seven[-1]}; --step selects others: " in said
    assert f"{', '.join(seven[:5])} and 1 more" in said


def test_a_cell_that_gives_nothing_of_the_kind_is_refused() -> None:
    run = run_of("a", "b")
    with pytest.raises(ArgumentError) as caught:
        output_of(run, "labels", "scan")
    assert str(caught.value) == (
        "the step scan has no labels of points; steps with labels of points: a, b"
    )
    with pytest.raises(ArgumentError, match=r"^the run r1 contains no cloud$"):
        output_of(run, "cloud", None)
    with pytest.raises(ArgumentError, match="steps with clouds: none"):
        output_of(run, "cloud", "a")


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
    with pytest.raises(
        ArgumentError, match="pass the store of the run with --store, or run the workflow"
    ):
        product_of(held, "sha256:" + "f" * 64, PointLabels, tmp_path / "store")


def test_a_folder_is_made_with_those_above_it(tmp_path: Path) -> None:
    make_empty(tmp_path / "a" / "b")
    make_empty(tmp_path / "a" / "b")
    (tmp_path / "a" / "b" / "file").touch()
    with pytest.raises(ArgumentError, match=r"cannot create .*file/c: Not a directory"):
        make_empty(tmp_path / "a" / "b" / "file" / "c")
