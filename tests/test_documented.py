"""Every command of the documents is one that the programs take: none names what is not there.

What is quick is also run, by tests/road/test_documents.py, in the order in which it stands.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from textwrap import indent
from typing import Final

import click
import pytest
from PIL import Image

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli.commands import Changes
from orthoflow.cli.program import program
from orthoflow.errors import OrthoflowError
from orthoflow.files.calibration import lens_for, read_calibration
from orthoflow.files.drawings.sheet_contents import read_title_block
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.source import shipped_workflow
from tests.documented import (
    ROOT,
    TEXTS,
    Documented,
    blocks,
    called,
    documented_commands,
    mentioned_options,
    written_files,
)

# Where documents leave the reader the choice of a workflow, or have it made in an earlier step.
NO_WORKFLOW_OF_OURS: Final = {
    *("FILE", "WORKFLOW", "comparison.yaml", "my.yaml"),
    "compare.yaml",  # of `plugins new`, or of an example
    "../beside-ours.yaml",  # needs two plugins: tests/test_examples.py
    "mine.yaml",  # of `orthoflow new`: tests/road/test_documents.py
}


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover_catalog()


@pytest.fixture(scope="module")
def readers_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that documents show in full; scans and photos are a reader's own."""
    folder = tmp_path_factory.mktemp("reader")
    for name, text in written_files().items():
        (folder / name).write_text(text)
    return folder


def test_every_command_is_one(
    catalog: Catalog, readers_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(readers_folder)
    ours = [one for one in documented_commands() if one.words[0] == "orthoflow"]
    assert len({one.path for one in ours}) > 12
    assert sum(one.is_block for one in ours) > 40
    wrong = [f"{one}: {said}" for one in ours if (said := _problem(one, catalog))]
    assert wrong == []


def _problem(command: Documented, catalog: Catalog) -> str:
    """What is wrong with a command, in words; nothing where it is sound."""
    try:
        values = called(command.words[1:])
    except click.ClickException as error:
        return error.format_message()
    name = values.get("workflow")
    if name is None or name in NO_WORKFLOW_OF_OURS or "..." in command.words:
        return ""
    given = {item.name: values.get(item.name, ()) for item in fields(Changes)}
    path = ROOT / name if (ROOT / name).is_file() else Path(name)
    try:
        Changes(**given | {"only_data": ()}).load(str(path), catalog)
    except OrthoflowError as error:
        return str(error)
    return ""


def test_every_file_that_a_document_names_exists() -> None:
    folders = "benchmarks|docs|examples|orthoflow|plugins|provenance|tests|workflows"
    named = rf"(?<![\w/.])((?:{folders})/[\w./-]+\.\w+)"
    missing = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in TEXTS
        for name in re.findall(named, path.read_text())
        if not (ROOT / name).exists()
    }
    assert missing == set()


def test_every_option_that_a_sentence_names_is_one() -> None:
    known: set[str] = {"--help"}
    targets: set[str] = set()

    def collect(command: click.Command, context: click.Context) -> None:
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                found = command.get_command(context, name)
                assert found is not None
                collect(found, context)
        for option in command.params:
            known.update(option.opts, option.secondary_opts)
            if "--to" in option.opts:
                assert isinstance(option.type, click.Choice)
                targets.update(option.type.choices)

    collect(program, click.Context(program))
    # A benchmark's options stand in its own text.
    scripts = "".join(path.read_text() for path in (ROOT / "benchmarks").glob("*.py"))
    of_dask = {"--memory-limit", "--nthreads", "--resources"}
    for path, option, value in mentioned_options():
        assert option in known | of_dask or f'"{option}"' in scripts, (
            f"{path}: no command takes {option}"
        )
        if option == "--to" and value and value != "FORMAT":
            assert value in targets, f"{path}: no export is called {value}"


def test_every_piece_of_a_workflow_is_one(catalog: Catalog, readers_folder: Path) -> None:
    n_whole = n_pieces = 0
    for path in TEXTS:
        for block in blocks(path, "yaml"):
            first = block.split(":")[0].strip()
            if first == "orthoflow":
                n_whole += 1
                text = block
            elif first == "plane":
                n_pieces += 1
                # A step of a workflow that has a cloud.
                step = block if block.startswith(" ") else indent(block, "  ")
                text = f"orthoflow: 1\nsteps:\n  cloud: {{use: simulate.room}}\n{step}"
            elif first == "datasets":
                n_pieces += 1
                text = written_files()["detectors.yaml"] + block
            elif "{use: " in block:
                n_pieces += 1
                # A step more, behind those of the main job.
                text = shipped_workflow("photos-on-scan").read_text() + indent(block, "  ")
            else:
                continue
            (readers_folder / "block.yaml").write_text(text)
            load_workflow(readers_folder / "block.yaml", catalog)
    assert n_whole >= 2
    assert n_pieces >= 2


def test_the_calibration_and_the_title_block_of_the_documents_are_read(
    readers_folder: Path,
) -> None:
    (block,) = blocks(ROOT / "docs" / "own-data.md", "yaml", start="cameras:")
    (readers_folder / "shown.yaml").write_text(block)
    lens = lens_for(read_calibration(readers_folder / "shown.yaml"), "IMG_1.jpg", 6000, 4000)
    assert lens is not None
    assert lens.fx == 4210.5
    (block,) = blocks(ROOT / "docs" / "exports.md", "yaml", start="layout:")
    (readers_folder / "office.yaml").write_text(block)
    Image.new("RGB", (4, 4)).save(readers_folder / "logo.png")
    assert read_title_block(readers_folder / "office.yaml").revisions[0].mark == "A"


def test_every_block_of_python_is_python() -> None:
    for path in TEXTS:
        for block in blocks(path, "python"):
            compile(block + " ...\n" * block.rstrip().endswith(":"), str(path), "exec")


def test_authors_of_plugins_are_told_every_unit() -> None:
    from orthoflow.testing.checks import UNIT_SUFFIXES

    text = (ROOT / "docs" / "plugin-authors.md").read_text(encoding="utf-8")
    (units,) = re.findall(r"its unit in its name: (.*?)\. Counts", text, re.DOTALL)
    assert set(re.findall(r"`_(\w+)`", units)) == set(UNIT_SUFFIXES)


def test_what_authors_of_plugins_are_shown_works(tmp_path: Path) -> None:
    """The blocks of docs/plugin-authors.md, about a method that is there."""
    import numpy as np
    from orthoflow_plugins.plane.hough2d import Hough2d

    from orthoflow import products, sdk, testing

    homes = (products, sdk, testing)
    known = {name: getattr(home, name) for home in homes for name in home.__all__}
    known |= {
        "dataclass": dataclass,
        "np": np,
        "pytest": pytest,
        "Path": Path,
        "Mine": Hough2d,
        "my_inputs": {},
        "ctx": sdk.StepContext(rng=np.random.default_rng(0), cores=1, scratch=tmp_path),
        "__file__": str(tmp_path / "test_mine.py"),
    }
    for block in blocks(ROOT / "docs" / "plugin-authors.md", "python"):
        shown = block.replace("plane.mine", "plane.hough2d").replace("check-name", "results-repeat")
        exec(shown + " ...\n" * shown.rstrip().endswith(":"), known)
    assert known["FlatWalls"].id.partition(".")[0] in discover_catalog().kinds
    assert len(known["CASES"]) > 10
    assert known["orthoflow_kinds"]()[0].name == "mark"
    assert known["orthoflow_products"]()[0].type_name == "marks"
    known["test_the_floor_is_found"](tmp_path)
