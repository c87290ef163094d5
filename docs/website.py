"""The documents as a site: `python docs/website.py` writes it to `site/`; reading fetches nothing.

The pages in this folder and the texts at the root of the repository are taken as they are, links
and all; the references of methods, products, metrics and commands are made of what plugins and the
command line declare.
"""

from __future__ import annotations

import argparse
import inspect
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Final

import click

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli.program import program
from orthoflow.report.metric_words import metric_words
from orthoflow.report.rankings import Sense, sense_of
from orthoflow.sdk import Method, port_specs
from orthoflow.workflow.methods import describe_method

ROOT: Final = Path(__file__).resolve().parents[1]
DOCS: Final = ROOT / "docs"
# Texts from elsewhere in the repository, and where they stand on the site.
ELSEWHERE: Final = {
    "README.md": "overview.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "plugins/README.md": "plugins-first.md",
    "provenance/SPEC.md": "record.md",
}
_LINK: Final = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")
_UNITS: Final = {
    "_mm": "mm",
    "_m": "m",
    "_deg": "deg",
    "_s": "s",
    "_px": "px",
    "_mib": "MiB",
    "_cells": "cells",
    "_grey": "grey levels",
    "_share": "share",
}


def written(folder: Path) -> None:
    """Write all pages into a folder."""
    pages = {f"docs/{path.name}": path.name for path in sorted(DOCS.glob("*.md"))} | ELSEWHERE
    for source, target in pages.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        (folder / target).write_text(_linked(text, source, pages), encoding="utf-8")
    shutil.copytree(DOCS / "pictures", folder / "pictures")
    reference = folder / "reference"
    reference.mkdir()
    catalog = discover_catalog()
    for name, text in {
        "methods.md": "\n".join(_methods(catalog)),
        "products.md": "\n".join(_products(catalog)),
        "metrics.md": "\n".join(_metrics(catalog)),
        "commands.md": "\n".join(_commands()),
    }.items():
        (reference / name).write_text(text, encoding="utf-8")


def _linked(text: str, source: str, pages: dict[str, str]) -> str:
    """Lead links to where things stand on the site; what does not is only named."""

    def link(found: re.Match[str]) -> str:
        to, anchor = found[1], found[2] or ""
        if "://" in to or to.startswith(("mailto:", "reference/")):
            return found[0]
        path = os.path.normpath(Path(source).parent / to)
        if path in pages:
            return f"]({pages[path]}{anchor})"
        if path.startswith("docs/pictures/"):
            return f"]({path.removeprefix('docs/')})"
        if not (ROOT / path).exists():
            raise SystemExit(f"{source} links to {to}, which is not there")
        return f"] (`{path}`)"

    linked = _LINK.sub(link, text)
    return re.sub(r"(?<!!)\[([^\[\]]+)\] \(`([^`]+)`\)", r"\1 (`\2`)", linked)


def _methods(catalog: Catalog) -> Iterator[str]:
    yield "# Methods\n\nAs plugins declare them; `orthoflow plugins show ID` says it, too.\n"
    infos = [describe_method(catalog, name) for name in sorted(catalog.methods)]
    for kind in sorted({info.id.partition(".")[0] for info in infos}):
        yield f"## {kind}\n\n{catalog.kinds[kind].spec.summary}\n"
        for info in infos:
            if info.id.partition(".")[0] == kind:
                yield from _method(info.method)


def _method(method: type[Method]) -> Iterator[str]:
    yield f"### {method.id}\n\n{_paragraphs(method)}\n"
    for word, table in (("takes", method.In), ("gives", method.Out)):
        for port in port_specs(table).values():
            behind = "" if port.required else ", optional"
            product = f"[{port.type_name}](products.md#{port.type_name})"
            yield f"- {word} `{port.name}`: {product}{behind}"
    yield ""
    fields = method.Params.model_fields
    if fields:
        yield "| parameter | default | meaning |\n|---|---|---|"
        for name, field in fields.items():
            default = (
                "required"
                if field.is_required()
                else f"`{field.get_default(call_default_factory=True)!r}`"
            )
            yield f"| `{name}` | {_cell(default)} | {_cell(field.description or '')} |"
        yield ""
    if method.citations:
        yield f"Cite: {'; '.join(method.citations)}.\n"


def _paragraphs(method: type[Method]) -> str:
    text = inspect.getdoc(method) or ""
    return text.partition("\nAttributes:")[0].strip()


def _products(catalog: Catalog) -> Iterator[str]:
    yield (
        "# Products and their files\n\nWhat steps hand to each other. A run folder has their files "
        "in `products/<step>/`.\n"
    )
    for name in sorted(catalog.products):
        spec = catalog.products[name].spec
        product = _loaded(spec.target)
        yield f"## {name}\n\n{spec.summary}\n"
        text = inspect.getdoc(product) or ""
        about, _, attributes = text.partition("Attributes:")
        yield f"{about.strip()}\n"
        if attributes:
            yield "| field | content |\n|---|---|"
            for field in re.findall(r"^    (\w+): (.*(?:\n        .*)*)", attributes, re.MULTILINE):
                yield f"| `{field[0]}` | {_cell(' '.join(field[1].split()))} |"
            yield ""


def _loaded(target: str) -> type:
    module, _, name = target.partition(":")
    found: type = getattr(import_module(module), name)
    return found


def _metrics(catalog: Catalog) -> Iterator[str]:
    yield (
        "# Metrics\n\nWhat methods measure. `all_` in front: over all walls; `wall_<k>_`: of that "
        "wall; `floor_`: what the intensity alone shows of itself.\n"
    )
    said: dict[str, set[str]] = {}
    for name in sorted(catalog.methods):
        for metric in describe_method(catalog, name).method.metrics:
            said.setdefault(metric, set()).add(name)
    kinds = sorted({method.partition(".")[0] for methods in said.values() for method in methods})
    for kind in kinds:
        yield f"## {kind}\n\n| metric | what | unit | good side | of |\n|---|---|---|---|---|"
        for metric, methods in said.items():
            own = [method for method in sorted(methods) if method.partition(".")[0] == kind]
            if own and not metric.startswith(
                ("all_", "floor_", "wall_", "*_", "worst_", "surf_floor")
            ):
                unit = next((unit for end, unit in _UNITS.items() if metric.endswith(end)), "")
                sense = sense_of(re.sub(r"\[(\w)\w*\]", r"\1", metric))
                good = "" if sense is Sense.NEITHER else sense.value
                plain = re.sub(r"\[(\w)\w*\]", r"\1", metric)
                yield f"| `{metric}` | {metric_words(plain)} | {unit} | {good} | {', '.join(own)} |"
        yield ""


def _commands() -> Iterator[str]:
    yield (
        "# Commands\n\n`orthoflow COMMAND --help` says the same. To complete commands, options "
        "and files, put this into `~/.bashrc` (`zsh_source` and `~/.zshrc`, or `fish_source`, for "
        "other shells):\n\n"
        '```sh\neval "$(_ORTHOFLOW_COMPLETE=bash_source orthoflow)"\n```\n'
    )
    with click.Context(program, info_name="orthoflow", terminal_width=100) as context:
        yield from _command(program, context)


def _command(command: click.Command, context: click.Context) -> Iterator[str]:
    names = command.list_commands(context) if isinstance(command, click.Group) else []
    if not names:
        yield f"## {context.command_path}\n\n```text\n{command.get_help(context)}\n```\n"
    for name in names:
        inner = command.get_command(context, name)
        if inner is not None:
            with click.Context(inner, info_name=name, parent=context) as own:
                yield from _command(inner, own)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def build(output: Path) -> None:
    """Build the site; a link that leads nowhere is an error."""
    with tempfile.TemporaryDirectory() as folder:
        pages = Path(folder) / "pages"
        pages.mkdir()
        written(pages)
        configuration = Path(folder) / "mkdocs.yml"
        shutil.copy(DOCS / "mkdocs.yml", configuration)
        command = [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "-q",
            "-f",
            str(configuration),
            "-d",
            str(output.resolve()),
        ]
        quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
        if subprocess.run(command, check=False, env=quiet).returncode:
            raise SystemExit("the site has mistakes, see above")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("site"))
    build(parser.parse_args().output)
