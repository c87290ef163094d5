"""Which files a workflow's inputs stand for."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import InputError
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.inputs import present_inputs, resolve_input_files


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
