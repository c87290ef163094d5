"""The documents followed to the letter: every command, in its order, in a folder of its own.

Rooms are small, so that a run takes a second; the one of the session's store less. `.ci/run --long`
follows the tutorial as it stands.
What every command must look like, quick or not, says tests/test_documented.py.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import pytest

import orthoflow
from orthoflow.products import PointCloud
from orthoflow.testing import example_room
from tests.documented import ROOT, blocks, commands_of, documented_commands, written_files
from tests.optional import need_programs
from tests.road.conftest import CHECKOUT, COARSE, Ended, Shell
from tests.scan_files import write_las


@dataclass(frozen=True)
class Story:
    """How a document is followed.

    Attributes:
        coarse: what is put behind each `run` and `plan`, so that it is quick.
        instead: words of the commands, and what stands for them.
    """

    coarse: Sequence[str] = ()
    instead: Mapping[str, str] = field(default_factory=dict)

    def follow(self, document: str, shell: Shell) -> dict[str, Ended]:
        """Type the commands of the document's blocks one after the other."""
        outputs = {}
        for command in commands_of(ROOT / document):
            if not command.is_block or command.words[0] != "orthoflow":
                continue
            words = [self.instead.get(word, word) for word in command.words[1:]]
            if words[0] in ("run", "plan"):
                words += self.coarse
            if words[0] in ("run", "replay"):
                words += ("--executor", "inline")  # loads libraries once for all steps
            if words[0] in ("replay", "export"):
                words += ("--store", str(shell.store))
            if words[0] == "cache":
                # That of the session is in use by other tests.
                own = shell.folder / "kept"
                own.mkdir(exist_ok=True)
                words += ("--store", str(own))
            outputs[command.text] = shell(*words, timeout_s=900)
        assert outputs, f"{document} has no commands"
        return outputs


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Path:
    """The folder of a finished run, as a reader has one called `first`."""
    shell = Shell(tmp_path_factory.mktemp("finished"), store)
    shell("run", "direct.yaml", *COARSE, "-o", "first", "--executor", "inline", timeout_s=900)
    return shell.folder / "first"


def test_the_tutorial(shell: Shell) -> None:
    # The short way to an orthoimage in the place of the long one.
    short = Story(coarse=COARSE, instead={"quickstart.yaml": "direct.yaml"})
    outputs = short.follow("docs/tutorial.md", shell)
    (promised,) = blocks(ROOT / "docs" / "tutorial.md", "text")
    said = outputs["orthoflow run quickstart.yaml -o first"].out
    assert [line for line in promised.splitlines() if line not in said.splitlines()] == []
    assert (shell.folder / "first" / "products" / "metrics.csv").is_file()
    assert "identical" in outputs["orthoflow replay first -o again"].out


@pytest.mark.long
def test_the_tutorial_as_it_stands(shell: Shell) -> None:
    Story().follow("docs/tutorial.md", shell)


def test_the_way_with_own_data(shell: Shell) -> None:
    cloud, _ = example_room()
    assert isinstance(cloud, PointCloud)
    points = cloud.points_world()
    grey = (32768 + 20000 * np.sin(3.0 * points.sum(axis=1))).astype(np.int64)
    rgb = np.column_stack([grey, grey, grey])
    write_las(shell.folder / "scan.laz", points, intensity=grey, rgb=rgb)
    Story(coarse=("--set", "wall.gsd_m=0.05")).follow("docs/own-data.md", shell)
    assert list((shell.folder / "mine" / "export" / "sheet").glob("wall_*_sheet_*.pdf"))


def test_the_comparison(shell: Shell) -> None:
    for name, text in written_files().items():
        (shell.folder / name).write_text(text)
    story = Story(coarse=("--set", "room.scan_step_m=0.08"))
    outputs = story.follow("docs/comparing.md", shell)
    swept = orthoflow.open_run(shell.folder / "swept").cells
    assert sum("tolerance_m-0_02" in address for address in swept) > 1
    assert (shell.folder / "both.html").is_file()
    listed = outputs["orthoflow runs . --sort started"].out
    assert [name for name in ("detectors", "swept", "fine") if name not in listed] == []


def test_the_archive(finished: Path, shell: Shell) -> None:
    shutil.copytree(finished, shell.folder / "first")
    outputs = Story().follow("docs/archiving.md", shell)
    replayed = outputs["orthoflow replay first-embedded -o repeated"].out
    assert "identical" in replayed
    assert (shell.folder / "crate").is_dir()


def test_the_signature(finished: Path, shell: Shell) -> None:
    need_programs("ssh-keygen")
    shutil.copytree(finished, shell.folder / "runs" / "palace")
    keygen = ["ssh-keygen", "-q", "-t", "ed25519", "-f", "jane", "-N", ""]
    subprocess.run(keygen, cwd=shell.folder, check=True)
    outputs = Story().follow("SECURITY.md", shell)
    assert "signed with SHA256:" in outputs["orthoflow verify runs/palace --signer jane.pub"].out


def test_the_lines_of_python(shell: Shell) -> None:
    (block,) = blocks(ROOT / "docs" / "python.md", "python")
    small = 'set={"room.scan_step_m": 0.08, "wall.gsd_m": 0.08}, store=STORE'
    shown, n_runs = re.subn(r"set=\{.*?\}", small, block.replace("quickstart", "direct"))
    assert n_runs == 1
    done = subprocess.run(
        [sys.executable, "-c", f"STORE = {str(shell.store)!r}\n{shown}\nprint(image.rgb.shape)"],
        cwd=shell.folder,
        env=shell.variables(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\(\d+, \d+, 3\)\n", done.stdout)


# Commands between backticks about a finished RUN that it is no run for, and who runs them.
NOT_OF_A_PLAIN_RUN: Final = {
    "orthoflow export RUN --split": "of datasets: tests/cli/test_datasets.py",
}


def test_what_sentences_say_of_a_finished_run(finished: Path, shell: Shell) -> None:
    shutil.copytree(finished, shell.folder / "RUN")
    (shell.folder / "office.yaml").write_text("project: Palace\n")
    sentences = {
        command.text: command.words[1:]
        for command in documented_commands()
        if command.words[0] == "orthoflow" and "RUN" in command.words
    }
    assert set(NOT_OF_A_PLAIN_RUN) <= set(sentences), "a reason without a command"
    for text, words in sentences.items():
        if text not in NOT_OF_A_PLAIN_RUN:
            filled = [{"FORMAT": "csv"}.get(word, word) for word in words]
            store = ("--store", shell.store) if words[0] == "export" else ()
            shutil.rmtree(shell.folder / "RUN" / "export", ignore_errors=True)
            shell(*filled, *store)


# The notebook in examples -------------------------------------------------------------------------


NOTEBOOK = ROOT / "examples" / "runs.ipynb"


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # of the notebook's own machinery
def test_the_notebook_runs_and_shows_what_it_promises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import nbclient
    import nbformat

    monkeypatch.setenv("PYTHONPATH", ":".join(CHECKOUT))
    # Charts are shown in the notebook unless a reader's surroundings say otherwise.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    # Half the points along each side: what is asserted needs no more.
    assert notebook.cells[1].source.count("0.04") == 2
    notebook.cells[1].source = notebook.cells[1].source.replace("0.04", "0.08")
    # In one process, which loads libraries once for all steps.
    for cell in notebook.cells:
        cell.source = cell.source.replace('"direct.yaml", ', '"direct.yaml", executor="inline", ')
    client = nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    shown = [
        output.data
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "execute_result"
    ]
    assert "first orthoimage" in shown[0]["text/html"]
    assert "completeness" in shown[1]["text/html"]
    assert "data:image/webp" in shown[2]["text/html"]
    runs = [orthoflow.open_run(folder) for folder in sorted((tmp_path / "runs").iterdir())]
    assert [run.record.status for run in runs] == ["ok"] * 3
    shutil.rmtree(tmp_path / "runs")
