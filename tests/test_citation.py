"""What a scientific project shows at its door agrees with the program."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import orthoflow

ROOT = Path(__file__).resolve().parents[1]


def test_the_citation_is_of_this_version_and_has_what_its_format_wants() -> None:
    citation = YAML(typ="safe").load(ROOT / "CITATION.cff")
    assert citation["version"] == orthoflow.__version__
    assert {"cff-version", "message", "title", "authors", "license"} <= set(citation)
    dois = [entry["doi"] for entry in citation["references"] if "doi" in entry]
    # As the methods themselves ask for it.
    source = (ROOT / "plugins/orthoflow_plugins/inspect/surf.py").read_text()
    assert dois
    assert all(f"doi:{doi.split('/')[0]}" in source for doi in dois)


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "README.md"])
def test_files_that_are_named_are_there(name: str) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / name).read_text())
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_changelog_is_of_this_version_and_read_in_two_minutes() -> None:
    newest = (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1]
    assert newest.startswith(orthoflow.__version__)
    assert len(newest.split()) < 700, "more than one page"
