"""What each command prints, reviewed as text in a snapshot; times, digests and machines masked.

Tests of behaviour assert on exit codes, JSON and files; the wording of a command is here only.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from syrupy.assertion import SnapshotAssertion

from orthoflow.cli import plugins
from tests.laboratories import laboratory_catalog
from tests.provenance_records import write_sample
from tests.studios import Studio, open_finished_studio, said

# What differs between runs and machines.
MASKS = (
    (r".* so far.*\n|, plus .* loading and compiling", ""),
    (r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?Z)?", "DATE"),
    (r"\b\d{8}-\w{6,}(-\w+)?\b", "RUN-ID"),
    (r"\b[0-9a-f]{64}\b", "DIGEST"),
    (r"\b[0-9a-f]{12}\b", "DIGEST"),
    (r"(< )?\b\d+(\.\d+)? s\b", "TIME"),
    (r"\b\d+(\.\d+)? [KMG]iB\b", "SIZE"),
    (r"[\d,]+ bytes", "SIZE"),
    (r"orthoflow(-tls)? \d+\.\d+[.\w]*", "orthoflow VERSION"),
    (r"environment: .*\n.*listed by --json", "environment: MACHINE"),
    (r" +(?=\n|$)|(?<=\S)  +(?=\S)", "  "),
)


def masked(text: str) -> str:
    for pattern, mask in MASKS:
        text = re.sub(pattern, mask, text)
    return "\n".join(line.rstrip() for line in text.split("\n"))


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """Two runs of one workflow: `first`, and `second` with another parameter."""
    with pytest.MonkeyPatch.context() as patch:
        opened = open_finished_studio(tmp_path_factory.mktemp("output"), patch)
        opened.run("second", "--set", "survey.offset_m=-3")
        (opened.folder / "wrong.yaml").write_text(
            "orthoflow: 1\nsteps: {a: {use: survey.offsett}}\n"
        )
        yield opened


COMMANDS = [
    "new n.txt",
    "check studio.yaml",
    "plan studio.yaml --set survey.offset_m=-3 --set paint.grey=9",
    "plan studio.yaml --set survey.offset_m=-3 --set paint.grey=9 --json",
    "plan studio.yaml --set survey.offset_m=7",
    "graph studio.yaml",
    "run studio.yaml -o second",
    "run studio.yaml -o third --set survey.offset_m=-3",
    "show second --all",
    "runs first second",
    "compare first second",
    "report first",
    "verify first",
    "replay first -o again",
    "export first --to csv",
    "cache gc --older-than 0 --dry-run",
    "cache verify",
    "plugins show paint.plain",
    # Mistakes of users: a sentence, and 2.
    "chek studio.yaml",
    "check nowhere.yaml",
    "check .",
    "check wrong.yaml",
    "check studio.yaml --set paint.gray=9 --input numbers=n.txt",
    "check studio.yaml --input number=none.txt",
    "run studio.yaml --ouput x",
    "run studio.yaml --jobs two",
    "run studio.yaml --jobs 0",
    "run direct --set wall.near=[[1, 2]]",
    "plan studio.yaml --until pant",
    "plugins show paint.plane",
    "show nowhere",
    "show n.txt",
    "report first second",
    "report nowhere",
    "compare first nowhere",
    "verify n.txt",
    "verify nowhere",
    "replay first --input numbers=n.txt",
    "export first --to lax",
    "export first --to csv --scale 50",
    "export first --to csv --embed",
    "export first --to csv --split",
    "export first --to csv -o first",
    "new nowhere.e57",
    "doctor --stor x",
]


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_prints_what_was_reviewed(
    words: str, studio: Studio, snapshot: SnapshotAssertion
) -> None:
    done = studio(*words.split())
    assert "Traceback" not in done.output
    text = done.output.replace(str(studio.folder), "FOLDER")
    assert f"exit {done.exit_code}\n{masked(text)}" == snapshot


def test_a_record_with_a_failed_and_a_cached_step_is_shown(
    tmp_path: Path, snapshot: SnapshotAssertion
) -> None:
    path, _, _ = write_sample(tmp_path)
    assert masked(said("show", path).replace(str(tmp_path), "FOLDER")) == snapshot
    answer = json.loads(said("show", path, "--json"))
    assert [cell["status"] for cell in answer["cells"]] == ["ok", "ok", "failed"]
    assert answer["cells"][1]["figures"] == [
        {"name": "residuals", "caption": "Résidus", "media_type": "image/png"}
    ]


@pytest.mark.parametrize("words", ["list", "show plane.ransac", "show plane.ransac --json"])
def test_methods_kinds_and_products_are_listed(
    words: str, monkeypatch: pytest.MonkeyPatch, snapshot: SnapshotAssertion
) -> None:
    catalog = laboratory_catalog(monkeypatch)
    monkeypatch.setattr(plugins, "discover_catalog", lambda: catalog)
    assert said("plugins", *words.split()) == snapshot
    listed = json.loads(said("plugins", "list", "--json"))
    kinds = {one["name"]: one for one in listed["kinds"]}
    assert kinds["plane"]["out"] == {"planes": "planes", "labels": "labels"}
    assert (kinds["plane"]["is_source"], kinds["read"]["is_source"]) == (False, True)
