"""Which files a workflow's inputs stand for, and what a valid workflow may still not mean."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.errors import InputError
from orthoflow.workflow.checks import lint_workflow
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.inputs import present_inputs, resolve_input_files
from tests.laboratories import GOOD, load


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a workflow and data, which is not the working directory."""
    folder = tmp_path / "project"
    for name in ("b.jpg", "a.jpg", ".hidden.jpg", "deep/c.jpg", "[1].jpg"):
        path = folder / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (folder / "empty").mkdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.jpg").touch()
    monkeypatch.chdir(elsewhere)
    return folder


def names(project: Path, catalog: Catalog, spec: str, *options: str) -> list[str] | None:
    path = project / "flow.yaml"
    path.write_text(
        f"orthoflow: 1\ninputs: {{photos: {spec.replace('PROJECT', str(project))}}}\n"
        f"steps: {{shots: {{use: read.photos, in: {{files: inputs.photos}}}}}}\n"
    )
    workflow = load_workflow(path, catalog, inputs=options)
    files = resolve_input_files(workflow)["photos"]
    assert (files is not None) == ("photos" in present_inputs(workflow))
    if files is None:
        return None
    assert files.name == "photos"
    assert all(item.is_file() and item.is_absolute() for item in files.paths)
    return [item.name for item in files.paths]


FOUND = {
    "{files: PROJECT/photos/a.*}": ["a.jpg"],
    "{files: photos}": ["[1].jpg", "a.jpg", "b.jpg", "c.jpg"],
    "{files: photos/*.jpg}": ["[1].jpg", "a.jpg", "b.jpg"],
    "{files: 'photos/[1].jpg'}": ["[1].jpg"],
    "{files: 'photos/**/?.jpg'}": ["a.jpg", "b.jpg", "c.jpg"],
    "{files: [photos/deep, photos/b.jpg, photos/b.*]}": ["b.jpg", "c.jpg"],
    "{optional: true}": None,
    "{files: empty, optional: true}": None,
}
MISSING = {
    "{files: nowhere.jpg}": (
        r"\.yaml:\d+:\d+: inputs.photos.files: input photos: there is no file nowhere.jpg"
    ),
    "{files: '*.png'}": r"input photos: no file matches \*.png next to the workflow",
    "{files: empty}": r"photos: the folder empty next to the workflow \(.*\) contains no files",
    "{files: /nowhere/x.jpg}": r"input photos: there is no file /nowhere/x\.jpg$",
    "{files: photos/b_.jpg}": r"no file photos/b_\.jpg next to .* \(did you mean b\.jpg\?\)",
    "{files: [photos/a.jpg, x.jpg]}": "input photos: there is no file x.jpg",
    "{}": r"input photos has no files; list them .* or pass --input photos=PATH",
}


def test_files_are_found_beside_the_workflow_and_sorted_by_name(
    project: Path, catalog: Catalog
) -> None:
    assert {spec: names(project, catalog, spec) for spec in FOUND} == FOUND
    for spec, message in MISSING.items():
        with pytest.raises(InputError, match=message):
            names(project, catalog, spec)


def test_an_input_option_must_exist_even_when_the_input_is_optional(
    project: Path, catalog: Catalog
) -> None:
    with pytest.raises(InputError, match=r"there is no file a\.jpg in the working directory"):
        names(project, catalog, "{optional: true}", "photos=a.jpg")


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
