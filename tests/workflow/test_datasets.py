"""Datasets: what a workflow and a table may say of them, and the cells they become."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import ArgumentError, InputError, WorkflowError
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import Cell, derive_seed, expand_cells
from orthoflow.workflow.inputs import resolve_input_files
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.source import InvalidWorkflowError
from orthoflow.workflow.views import resolved_json, workflow_from_resolved
from tests.laboratories import ROOMS

MISTAKEN = """\
orthoflow: 1
inputs:
  scan: {files: hall.e57}
steps:
  cloud: {use: read.scan, in: {files: inputs.scan}, params: {unit: parsec}}
  plane: {use: plane.hough2d, in: {cloud: cloud.cloud}, params: {tolerance_m: -1}}
datasets:
  hall: {set: {plane.cell_m: -3}}
  lost: {scan: lost.e57, set: {plane.tolerance_m: x}}
"""
TWO = "datasets: {hall: {scan: hall.e57}, stairs: {scan: stairs.e57}}\n"
AFTER = ("plane", "wall", "ties")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the files that the rooms name."""
    monkeypatch.chdir(tmp_path)
    for name in ("shared.jpg", "hall.e57", "stairs.e57", "attic.e57"):
        (tmp_path / name).write_text(name)
    return tmp_path


def test_mistakes_of_steps_and_of_datasets_and_missing_files_are_told_in_one_pass(
    folder: Path, catalog: Catalog
) -> None:
    with pytest.raises(InvalidWorkflowError) as caught:
        load(MISTAKEN, catalog, also_files=True)
    assert [(problem.line, problem.path) for problem in caught.value.problems] == [
        (5, "steps.cloud.params.unit"),
        (6, "steps.plane.params.tolerance_m"),
        (8, "datasets.hall.set.plane.cell_m"),
        (9, "datasets.lost.scan"),
        (9, "datasets.lost.set.plane.tolerance_m"),
    ]
    assert caught.value.problems[3].message == (
        f"input scan@lost: there is no file lost.e57 next to the workflow ({folder / 'lost.e57'}) "
        "(did you mean stairs.e57?)"
    )


def load(text: str, catalog: Catalog, **options: object) -> Workflow:
    Path("rooms.yaml").write_text(text, encoding="utf-8")
    return load_workflow("rooms.yaml", catalog, **options)  # type: ignore[arg-type]


def cells(text: str, catalog: Catalog, **options: object) -> dict[str, Cell]:
    found = expand_cells(load(text, catalog, **options), catalog)
    return {cell.address: cell for cell in found}


def table(text: str, name: str = "rooms.csv") -> str:
    Path(name).write_text(text, encoding="utf-8")
    return name


def test_what_hangs_on_the_data_fans_out_and_all_else_runs_once(catalog: Catalog) -> None:
    found = cells(ROOMS + TWO, catalog)
    places = [("cloud", ""), ("room", ""), *((step, ",plane=hough2d") for step in AFTER)]
    assert list(found) == [
        "shots",
        *(f"{step}@data={d}{more}" for step, more in places for d in ("hall", "stairs")),
    ]
    assert str(found["cloud@data=hall"].inputs["files"]) == "inputs.scan@hall"
    assert list(found["wall@data=hall,plane=hough2d"].assignment) == ["data", "plane"]


def test_parameters_of_a_dataset_go_before_those_of_the_file_and_behind_the_command_line(
    catalog: Catalog,
) -> None:
    def cell_m(*sets: str) -> list[object]:
        found = cells(text, catalog, sets=sets)
        assert ("plane@plane=hough2d" in found, "shots" in found) == (False, True)
        return [found[f"plane@data={name},plane=hough2d"].params["cell_m"] for name in "ab"]

    text = ROOMS + "datasets: {a: {set: {plane.hough2d.cell_m: 0.01}}, b: {}}\n"
    assert cell_m() == [0.01, 0.02]
    assert cell_m("plane.hough2d.cell_m=0.03") == [0.03, 0.03]
    # Only that step, and what follows, hangs on the data.
    found = cells(ROOMS + "datasets: {a: {set: {wall.gsd_m: 0.5}}, b: {}}\n", catalog)
    assert "plane@plane=hough2d" in found
    assert found["wall@data=a,plane=hough2d"].params["gsd_m"] == 0.5


def test_whether_a_step_is_needed_may_hang_on_the_data(catalog: Catalog) -> None:
    datasets = "datasets: {hall: {scan: hall.e57}, made: {}}\n"
    found = cells(ROOMS + datasets, catalog)
    assert found["room@data=hall"].skip_reason == "only without the input scan"
    assert not found["room@data=made"].skip_reason
    assert found["cloud@data=made"].skip_reason
    source = found["plane@data=made,plane=hough2d"].inputs["cloud"]
    assert str(source) == "room@data=made.cloud"
    asked = cells(ROOMS.replace("unless:", "if:") + datasets, catalog)
    assert not asked["room@data=hall"].skip_reason
    assert asked["room@data=made"].skip_reason == "only with the input scan"


def test_files_of_datasets_that_were_not_chosen_are_not_looked_for(
    catalog: Catalog, folder: Path
) -> None:
    text = ROOMS + "datasets: {hall: {scan: hall.e57}, gone: {scan: gone.e57}}\n"
    files = resolve_input_files(load(text, catalog, only_data=["hall"]))
    assert {name for name, found in files.items() if found} == {"photos", "scan@hall"}
    with pytest.raises(InputError, match=r"\.yaml:(\d+):\d+: datasets.gone.scan: input "):
        resolve_input_files(load(text, catalog))


def test_paths_of_a_table_start_at_the_table(catalog: Catalog, folder: Path) -> None:
    (folder / "survey").mkdir()
    (folder / "survey" / "hall.e57").write_text("another")
    named = table("name,scan\nhall,hall.e57\n", "survey/rooms.csv")
    for text, given in ((ROOMS, named), (f"{ROOMS}datasets: {named}\n", "")):
        files = resolve_input_files(load(text, catalog, datasets=given))["scan@hall"]
        assert files is not None
        assert files.paths == (folder / "survey" / "hall.e57",)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_table_says_what_the_mapping_says(mark: str, catalog: Catalog) -> None:
    text = (
        "\ufeffname; scan; wall.gsd_m; plane.normal\n# by hand\n\nhall;hall.e57;0.5;\n"
        'stairs;;;"[0, 0, 1]"\n'
    )
    named = table(text.replace(";", mark))
    mapping = (
        "datasets: {hall: {scan: hall.e57, set: {wall.gsd_m: 0.5}}, "
        "stairs: {set: {plane.normal: [0, 0, 1]}}}\n"
    )
    assert cells(ROOMS, catalog, datasets=named) == cells(ROOMS + mapping, catalog)


def test_a_resolved_workflow_keeps_its_datasets(catalog: Catalog) -> None:
    text = ROOMS + "datasets: {hall: {scan: hall.e57, set: {wall.gsd_m: 0.5}}, attic: {}}\n"
    workflow = load(text, catalog, only_data=["hall"])
    resolved = resolved_json(workflow)
    again = workflow_from_resolved(resolved, workflow.source)
    assert [item.name for item in again.chosen_data] == ["hall"]
    assert again.datasets["hall"].sets == {"wall.gsd_m": 0.5}
    assert set(again.input_specs) == {"photos", "scan@hall"}
    assert resolved_json(again) == resolved


def test_a_table_has_a_largest_number_of_datasets(catalog: Catalog) -> None:
    text = "name\n" + "".join(f"r{index}\n" for index in range(10_001))
    message = r"^rooms\.csv:10002:1: a table has at most 10000 datasets"
    with pytest.raises(WorkflowError, match=message):
        load(ROOMS, catalog, datasets=table(text))


def test_a_dataset_without_files_takes_those_of_the_workflow(catalog: Catalog) -> None:
    text = ROOMS.replace("scan: {optional: true}", "scan: {}").replace(", unless: inputs.scan", "")
    datasets = "datasets: {hall: {scan: hall.e57}, made: {}}\n"
    shared = load(text + datasets, catalog, inputs=["scan=attic.e57"])
    assert set(shared.input_specs) == {"photos", "scan@hall", "scan"}


def test_a_changed_record_of_datasets_is_refused(catalog: Catalog, folder: Path) -> None:
    resolved = resolved_json(load(ROOMS + TWO, catalog))
    for old, new in [
        ('"datasets":{"hall"', '"datasets":{"../hall"'),
        ('"hall":{"inputs":{"scan"', '"hall":{"inputs":{"scans"'),
        ('"set":{}', '"set":[]'),
    ]:
        assert old in resolved
        with pytest.raises((WorkflowError, ArgumentError)):
            workflow_from_resolved(resolved.replace(old, new, 1), "")


def test_datasets_that_can_hardly_be_meant_are_doubted(catalog: Catalog) -> None:
    idle = load(ROOMS + "datasets: {hall: {}, attic: {}}\n", catalog)
    assert lint_workflow(idle) == (
        "the datasets have no effect: they set no parameter and no input that a step uses",
        *lint_workflow(load(ROOMS, catalog)),
    )
    coarse = load(ROOMS + "datasets: {hall: {set: {wall.gsd_m: 3}}, attic: {}}\n", catalog)
    (said,) = set(lint_workflow(coarse)) - set(lint_workflow(load(ROOMS, catalog)))
    assert said.startswith("wall.gsd_m of dataset hall is 3 m, which is implausible")


def test_seeds_of_datasets_reach_what_is_random_and_what_follows(catalog: Catalog) -> None:
    text = ROOMS + ("datasets: {a: {set: {seed: 1}}, b: {set: {seed: {sweep: [2, 3]}}}, c: {}}\n")
    found = cells(text, catalog)
    rooms = [address.removeprefix("room@data=") for address in found if "room" in address]
    assert rooms == ["a,seed=1", "b,seed=2", "b,seed=3", "c,seed=5"]
    assert found["room@data=b,seed=3"].seed == derive_seed(3, "simulate.room", 0)
    assert "wall@data=c,seed=5,plane=hough2d" in found
    # What is not random, and takes nothing random, runs once.
    assert "shots" in found
    assert load(text, catalog).datasets["b"].seeds == (2, 3)

    named = table("name,seed\na,7\nb,8\n")
    found = cells(ROOMS, catalog, datasets=named)
    rooms = [name for name in found if "room" in name]
    assert rooms == ["room@data=a,seed=7", "room@data=b,seed=8"]
