"""The project's documents: citation, changelog, links, and the site with its reference."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from ruamel.yaml import YAML

import orthoflow
from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog

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


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover_catalog()


def test_words_of_messages_are_said_somewhere() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    table = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(table) > 8
    sources = "".join(
        re.sub(r'["\']\s*\n\s*f?["\']', "", path.read_text())
        for folder in ("orthoflow", "plugins", "provenance")
        for path in (ROOT / folder).rglob("*.py")
    )
    for line in table:
        for words in re.findall(r"`([^`]+)`", line.split("|")[1]):
            assert words in sources, words


def test_parameters_that_are_said_to_help_exist(catalog: Catalog) -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    kinds = {"cloud": "read", "wall": "raster"} | {kind: kind for kind in catalog.kinds}
    named = re.findall(r"`([a-z]+)\.([a-z_]+)(?:=[^`]*)?`", text)
    known = {
        (name.partition(".")[0], parameter)
        for name in catalog.methods
        for parameter in catalog.method(name).load().Params.model_fields
    }
    asked = {(kinds[step], parameter) for step, parameter in named if step in kinds}
    assert len(asked) > 5
    assert asked <= known


def site() -> ModuleType:
    spec = importlib.util.spec_from_file_location("website", ROOT / "docs" / "website.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_has_every_method_product_metric_and_command(
    catalog: Catalog, tmp_path: Path
) -> None:
    site().written(tmp_path)
    pages = {path.stem: path.read_text() for path in (tmp_path / "reference").glob("*.md")}
    assert {name for name in catalog.methods if f"### {name}\n" not in pages["methods"]} == set()
    assert {name for name in catalog.products if f"## {name}\n" not in pages["products"]} == set()
    assert {
        "| `rmse_[uv]_mm` | error along ..., RMS | mm | lower is better | inspect.truth |",
        "| `rms_mm` | check points, RMS | mm | lower is better | inspect.checkpoints |",
        "| `scale_ppm` | deviation of the scale from 1 | ppm |  | register.similarity |",
        "| `peak_rss_mib` | memory | MiB | lower is better | all |",
    } <= set(pages["metrics"].splitlines())
    # What a product consists of, and what its numbers stand for.
    products = pages["products"]
    assert "(#camera)" in products
    assert "small rotation vector" in products.partition("### Camera\n")[2].partition("\n#")[0]
    assert "| 2 | `REJECTED` | the tie contradicts" in products
    assert "| 2 | `FILLED` | inpainted from" in products
    assert "## orthoflow plugins new\n" in pages["commands"]
    assert "_ORTHOFLOW_COMPLETE=bash_source" in pages["commands"]
    # Nothing leads out of the site but to the web.
    for page in tmp_path.rglob("*.md"):
        for link in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            assert "://" in link or (page.parent / link).exists(), (page.name, link)


def test_every_limit_of_a_reader_says_what_it_limits() -> None:
    readers = ("orthoflow.files.", "orthoflow.workflow.", "orthoflow_provenance.")
    found = [(module, name, what) for module, name, what in site().limits()]
    assert len(found) > 30
    assert not [
        f"{module}.{name}"
        for module, name, what in found
        if module.startswith(readers) and not what
    ]
