"""Every command of the documents is one that the programs take: none names what is not there.

What is quick is also run, by tests/road/test_documents.py, in the order in which it stands.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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

# Programs that are not ours, or that do what no test may: why none of their words are looked at.
NOT_OURS: Final[Mapping[str, str]] = {
    ".": "enters an environment",
    "ENV": "a line of a Dockerfile",
    "RUN": "a line of a Dockerfile",
    "cd": "goes elsewhere",
    "dask": "dask's own",
    "lint-imports": "CI runs it",
    "mypy": "CI runs it",
    "ruff": "CI runs it",
    "sed": "tests/test_plugin_readme.py runs it",
    "ssh-keygen": "OpenSSH's own",
}
# Options of programs that are not ours.
NOT_OUR_OPTIONS: Final[Mapping[str, str]] = {
    "--memory-limit": "of dask worker",
    "--nthreads": "of dask worker",
    "--resources": "of dask worker",
}
# Where documents leave the reader the choice of a workflow, or have it made in an earlier step.
NO_WORKFLOW_OF_OURS: Final[Mapping[str, str]] = {
    "FILE": "left to the reader",
    "WORKFLOW": "left to the reader",
    "comparison.yaml": "the reader's own",
    "compare.yaml": "written by `plugins new`, or of an example",
    "../beside-ours.yaml": "needs two plugins: tests/test_examples.py",
    "mine.yaml": "written by `orthoflow new`: tests/road/test_documents.py",
    "my.yaml": "the reader's own",
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


def test_documents_have_the_commands_that_this_looks_at() -> None:
    commands = documented_commands()
    assert len(commands) > 120
    assert len({command.path for command in commands}) > 15
    assert sum(command.is_block for command in commands) > 60
    first = {command.words[0] for command in commands}
    assert set(NOT_OURS) <= first, "a reason without a command"


@pytest.mark.parametrize("name", sorted({path.relative_to(ROOT).as_posix() for path in TEXTS}))
def test_every_command_is_one(
    name: str, catalog: Catalog, readers_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(readers_folder)
    wrong = [
        f"{command}: {said}"
        for command in documented_commands()
        if command.path == name and (said := problem(command, catalog))
    ]
    assert wrong == []


def problem(command: Documented, catalog: Catalog) -> str:
    """What is wrong with a command, in words; nothing where it is sound."""
    first, *rest = command.words
    judges: Mapping[str, Callable[[], str]] = {
        "orthoflow": lambda: _of_orthoflow(command, catalog),
        "python": lambda: _of_python(rest),
        "python3": lambda: _of_python(rest),
        "pip": lambda: _of_pip(rest),
        "pytest": lambda: _of_pytest(rest),
        ".ci/run": lambda: "" if (ROOT / ".ci" / "run").is_file() else "is not there",
    }
    if first in judges:
        return judges[first]()
    return "" if first in NOT_OURS else f"nobody says whether there is a program {first}"


def _of_orthoflow(command: Documented, catalog: Catalog) -> str:
    try:
        call = called(command.words[1:])
    except click.ClickException as error:
        return error.format_message()
    if (new := call.values.get("new_kind")) in catalog.kinds:
        return f"the kind {new} is there already"
    workflow = call.values.get("workflow")
    if isinstance(workflow, tuple):  # `warm` takes several
        workflow = workflow[0] if workflow else None
    if workflow is None or workflow in NO_WORKFLOW_OF_OURS or "..." in command.words:
        return ""
    name = str(workflow)
    path = ROOT / name if (ROOT / name).is_file() else Path(name)
    try:
        Changes(
            sets=tuple(map(str, call.values.get("sets") or ())),
            inputs=tuple(map(str, call.values.get("inputs") or ())),
            datasets=str(call.values.get("datasets") or ""),
            only_data=(),
            set_files=tuple(map(str, call.values.get("set_files") or ())),
        ).load(str(path), catalog)
    except OrthoflowError as error:
        return str(error)
    return ""


def _of_python(words: list[str]) -> str:
    if words[0] != "-m":
        return _of_script(ROOT / words[0], words[1:])
    module, *rest = words[1:]
    judges = {"venv": None, "http.server": None, "pip": _of_pip, "pytest": _of_pytest}
    if module in judges:
        judge = judges[module]
        return judge(rest) if judge else ""
    return _of_script(ROOT / f"{module.replace('.', '/')}.py", rest)


def _of_script(path: Path, words: list[str]) -> str:
    """Whether a script is there and names the options that it is given."""
    if not path.is_file():
        return f"there is no {path.relative_to(ROOT)}"
    text = path.read_text()
    return "".join(
        f"takes no {word}"
        for word in words
        if word[0] == "-" and word.partition("=")[0] not in text
    )


def _of_pip(words: list[str]) -> str:
    wanted = [word for word in words if re.match(r"(\.|orthoflow-tls)(\[|$)", word)]
    extras = {name for word in wanted for name in re.findall(r"[a-z]+", word.partition("[")[2])}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return "".join(f"no extra {name}" for name in extras - {*project["optional-dependencies"]})


def _of_pytest(words: list[str]) -> str:
    paths = [word for word in words if "/" in word or word == "tests"]
    return "".join(f"there is no {path}" for path in paths if not (ROOT / path).exists())


def test_every_file_that_a_document_names_exists() -> None:
    folders = "benchmarks|docs|examples|orthoflow|plugins|provenance|tests|workflows"
    named = rf"`((?:{folders})/[\w./-]+\.\w+|(?:examples|tests)/[\w/-]+)`"
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
    used = set()
    for path, option, value in mentioned_options():
        used.add(option)
        is_known = option in known or option in NOT_OUR_OPTIONS or f'"{option}"' in scripts
        assert is_known, f"{path}: no command takes {option}"
        if option == "--to" and value and value != "FORMAT":
            assert value in targets, f"{path}: no export is called {value}"
    assert set(NOT_OUR_OPTIONS) <= used, "a reason without an option"


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
                # A calibration, a title block (both read below), a file of parameters, the first
                # line of an editor.
                known = ("cameras", "layout", "plane.hough2d.tolerance_m", "# yaml-language-server")
                assert first in known
                continue
            (readers_folder / "block.yaml").write_text(text)
            load_workflow(readers_folder / "block.yaml", catalog)
    assert n_whole >= 2
    assert n_pieces >= 2


def test_the_calibration_of_the_documents_is_read(readers_folder: Path) -> None:
    (block,) = blocks(ROOT / "docs" / "own-data.md", "yaml", start="cameras:")
    (readers_folder / "shown.yaml").write_text(block)
    lens = lens_for(read_calibration(readers_folder / "shown.yaml"), "IMG_1.jpg", 6000, 4000)
    assert lens is not None
    assert lens.fx == 4210.5


def test_the_title_block_of_the_documents_is_read(readers_folder: Path) -> None:
    (block,) = blocks(ROOT / "docs" / "exports.md", "yaml", start="layout:")
    (readers_folder / "office.yaml").write_text(block)
    Image.new("RGB", (4, 4)).save(readers_folder / "logo.png")
    assert read_title_block(readers_folder / "office.yaml").revisions[0].mark == "A"


PYTHON_RUN_BY: Final = {
    "docs/python.md": "tests/road/test_documents.py",
    "docs/plugin-authors.md": "below",
    "plugins/README.md": "tests/test_plugin_readme.py",
}


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_block_of_python_is_python(path: Path) -> None:
    name = path.relative_to(ROOT).as_posix()
    for block in blocks(path, "python"):
        compile(block + " ...\n" * block.rstrip().endswith(":"), name, "exec")
        assert name in PYTHON_RUN_BY, f"nothing runs the Python of {name}"


def test_authors_of_plugins_are_told_every_unit() -> None:
    from orthoflow.testing.checks import UNIT_SUFFIXES

    text = (ROOT / "docs" / "plugin-authors.md").read_text(encoding="utf-8")
    (told,) = re.findall(r"its unit in its name: (.*?)\. Counts", text, re.DOTALL)
    assert set(re.findall(r"`_(\w+)`", told)) == set(UNIT_SUFFIXES)


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
