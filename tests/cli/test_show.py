"""What is shown of a run that has less than others, or more."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner
from orthoflow_provenance.document import Metric

from orthoflow.cli import program
from orthoflow.cli import show as module
from tests.report_runs import cell, compared_run


def shown(part: Any, run: Any, capsys: pytest.CaptureFixture[str]) -> list[str]:
    part(run)
    return capsys.readouterr().out.splitlines()


def run_of(*cells: Any, **known: Any) -> Any:
    return SimpleNamespace(record=SimpleNamespace(cells=cells, **known))


def test_a_run_without_metrics_has_no_table_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(module._print_metrics, run_of(cell("a")), capsys) == []
    told = cell("a", metrics=(Metric(name="rms_mm", value=1.5, unit="mm"),))
    assert shown(module._print_metrics, run_of(told), capsys) == [
        "",
        "step  metric  value  unit",
        "a     rms_mm  1.5    mm",
    ]


def test_of_many_metrics_those_that_say_how_good_results_are_stand_first(
    capsys: pytest.CaptureFixture[str],
) -> None:
    many = tuple(Metric(name=f"n_{index}", value=1.0, unit="1") for index in range(30))
    last = cell("last", metrics=(Metric(name="rms_mm", value=1.5, unit="mm"),))
    run = run_of(cell("a", metrics=many), last)
    module._print_metrics(run, most=20)
    told = capsys.readouterr().out.splitlines()
    assert told[2].split() == ["last", "rms_mm", "1.5", "mm"]
    assert (len(told), told[-1]) == (23, "and 11 more, which --all prints")
    assert len(shown(module._print_metrics, run, capsys)) == 33


def test_of_a_comparison_a_row_per_combination_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert module._print_comparison(compared_run(tmp_path))
    told = capsys.readouterr().out.splitlines()
    assert told[1].split()[:2] == ["combination", "plane.rms_mm"]
    rows = {line.split("  ")[0]: line for line in told[2:5]}
    assert list(rows) == ["plane=fine", "plane=coarse", "plane=broken"]
    assert "1.10 ± 0.10" in rows["plane=fine"]
    assert rows["plane=broken"].split()[1:] == ["-"] * (len(told[1].split()) - 1)
    assert told[5].startswith("means of the repeats ± their standard deviation")
    assert not module._print_comparison(run_of(cell("plane"), cell("a@data=b")))


def test_cells_are_counted_by_what_became_of_them() -> None:
    cells = [cell("a"), cell("b", status="skipped"), cell("c"), cell("d", status="failed")]
    assert module._status_text(run_of(*cells)) == "4 steps, 2 ok, 1 failed, 1 skipped"
    assert module._status_text(run_of(cell("a"))) == "1 step, 1 ok"


def test_files_that_are_gone_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published = [SimpleNamespace(path=f"products/{name}") for name in ("a.tif", "b.tif")]
    run: Any = SimpleNamespace(
        folder=tmp_path,
        products_folder=tmp_path / "products",
        orthoimages=[tmp_path / "products/a.tif"],
        record=SimpleNamespace(published=published),
    )
    (tmp_path / "products").mkdir()
    (tmp_path / "products/a.tif").touch()
    image = f"orthoimage: {tmp_path / 'products/a.tif'}"
    begin = f"products: {tmp_path / 'products'}"
    assert shown(module._print_files, run, capsys) == [
        "",
        f"{begin}, 1 file of the 2 that were published",
        image,
    ]
    (tmp_path / "products/b.tif").touch()
    assert shown(module._print_files, run, capsys) == ["", f"{begin}, 2 files", image]
    for name in ("a.tif", "b.tif"):
        (tmp_path / "products" / name).unlink()
    run.orthoimages = []
    said = "products: none of the 2 published files is beside the record"
    assert shown(module._print_files, run, capsys) == ["", said]


def test_a_metric_has_in_json_what_its_method_says_of_it() -> None:
    told = cell(
        "a",
        metrics=(
            Metric(name="rms_mm", value=0.0, unit="mm"),
            Metric(name="n", value=1.0, unit="1", label="points", better="higher", headline=True),
        ),
    )
    first, second = module._cell_json(told)["metrics"]  # type: ignore[misc]
    assert first == {"name": "rms_mm", "value": 0.0, "unit": "mm"}
    assert second == {
        "name": "n",
        "value": 1.0,
        "unit": "1",
        "label": "points",
        "better": "higher",
        "headline": True,
    }


def test_only_what_orthoflow_uses_itself_is_named_of_an_environment(
    capsys: pytest.CaptureFixture[str],
) -> None:
    environment = SimpleNamespace(
        python="3.12.1", os="Linux 6", cpu="a processor", cores=1, threads=2,
        git_commit="abc", packages={"numpy": "2", "stranger": "1", "H5py": "3"},
    )  # fmt: skip
    assert shown(module._print_environments, run_of(environments=[environment]), capsys) == [
        "",
        "environment: Python 3.12.1, Linux 6, a processor, 1 core, 2 threads, commit abc",
        "numpy 2, H5py 3 and 1 others (--json names them)",
    ]


def test_a_folder_without_runs_is_told_as_such(tmp_path: Path) -> None:
    result = CliRunner().invoke(program, ["show", str(tmp_path)])
    assert result.exit_code == 2
