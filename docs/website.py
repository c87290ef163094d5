"""Build the documentation site: `python docs/website.py` writes it to `site/`, to be read offline.

The pages in this folder and the texts at the root of the repository are used with adapted links.
The references of methods, products, metrics and commands are generated from the declarations of the
plugins and the command line.
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
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass, replace
from enum import IntEnum
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final, get_args, get_origin, get_type_hints

import click

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import discover_catalog
from orthoflow.cli.program import program
from orthoflow.files.sidecars import (
    LAYER_MASK_MEANINGS,
    ORTHO_MASK_MEANINGS,
    SURFACE_MASK_MEANINGS,
)
from orthoflow.products import LayerMask, OrthoMask, SurfaceMask
from orthoflow.records import COSTS
from orthoflow.report.rankings import BETTER
from orthoflow.sdk import Method, MetricSpec, port_specs

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
_MASKS: Final[Mapping[type, Mapping[Any, str]]] = {
    SurfaceMask: SURFACE_MASK_MEANINGS,
    LayerMask: LAYER_MASK_MEANINGS,
    OrthoMask: ORTHO_MASK_MEANINGS,
}
_NO_SEARCH: Final = (
    '<script>location.protocol === "file:" && document.documentElement.classList.add("by-file")'
    "</script><style>.by-file .md-search, .by-file [for=__search] {display: none}</style>"
)
_METRICS_HEAD: Final = "| metric | meaning | unit | better | method |\n|---|---|---|---|---|"
_LIMITED: Final = {
    "orthoflow": ROOT / "orthoflow",
    "orthoflow_provenance": ROOT / "provenance" / "orthoflow_provenance",
}
# A limit for files, with the comment that describes the limited quantity.
_LIMIT: Final = re.compile(
    r"^(?:#: (?P<what>.+)\n)?(?P<name>(?:MOST|MAX|DEEPEST|FARTHEST)\w*): Final", re.MULTILINE
)
_LINK: Final = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


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
        "limits.md": "\n".join(_limits()),
    }.items():
        (reference / name).write_text(text, encoding="utf-8")


def _linked(text: str, source: str, pages: dict[str, str]) -> str:
    """Adapt links to pages of the site; links to other files are replaced by their paths."""

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
            raise SystemExit(f"{source} links to {to}, which does not exist")
        return f"] (`{path}`)"

    linked = _LINK.sub(link, text)
    return re.sub(r"(?<!!)\[([^\[\]]+)\] \(`([^`]+)`\)", r"\1 (`\2`)", linked)


def _methods(catalog: Catalog) -> Iterator[str]:
    yield (
        "# Methods\n\nThis page lists the methods as declared by plugins; `orthoflow plugins show "
        "ID` prints the same.\n"
    )
    methods = [catalog.method(name).load() for name in sorted(catalog.methods)]
    for kind in sorted({method.id.partition(".")[0] for method in methods}):
        yield f"## {kind}\n\n{catalog.kinds[kind].spec.summary}\n"
        for method in methods:
            if method.id.partition(".")[0] == kind:
                yield from _method(method)


def _method(method: type[Method]) -> Iterator[str]:
    yield f"### {method.id}\n\n{_paragraphs(method)}\n"
    for word, table in (("input", method.In), ("output", method.Out)):
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
        "# Products and their files\n\nProducts are the data that steps exchange. Their files are "
        "in `products/<step>/` of a run folder. The fields are those of the objects that "
        "`run.product(step, name)` returns in Python; parts of a product are described after the "
        "first product that contains them.\n"
    )
    products = {name: _loaded(catalog.products[name].spec.target) for name in catalog.products}
    places = {product: name for name, product in products.items()}
    for name in sorted(products):
        yield f"## {name}\n\n{catalog.products[name].spec.summary}\n"
        yield from _fields(products[name], places)
        below = [part for part in _parts(products[name]) if part not in places]
        while below:
            part = below.pop(0)
            if part not in places:
                places[part] = part.__name__.lower()
                yield f"### {part.__name__}\n"
                yield from _fields(part, places)
                below = [inner for inner in _parts(part) if inner not in places] + below


def _fields(described: type, places: dict[type, str]) -> Iterator[str]:
    """Return the docstring of a product, a part of one or an enumeration, fields as a table."""
    about, _, attributes = (inspect.getdoc(described) or "").partition("Attributes:")
    yield f"{about.strip()}\n"
    said = {
        name: " ".join(text.split())
        for name, text in re.findall(r"^    (\w+): (.*(?:\n        .*)*)", attributes, re.MULTILINE)
    }
    if issubclass(described, IntEnum):
        meanings = _MASKS.get(described, {})
        texts = {
            member: meanings.get(member, "").partition(": ")[2] or said.get(member.name, "")
            for member in described
        }
        is_told = any(texts.values())
        yield "| number | name |" + " meaning |" * is_told + "\n|---|---|" + "---|" * is_told
        for member, text in texts.items():
            yield f"| {member:d} | `{member.name}` |" + f" {_cell(text)} |" * is_told
    elif said:
        parts = _parts_of_fields(described)
        yield "| field | content |\n|---|---|"
        for name, text in said.items():
            named = ", ".join(
                f"[{part.__name__}](#{places.get(part, part.__name__.lower())})"
                for part in parts.get(name, ())
            )
            yield f"| `{name}` | {_cell(text)}{f' ({named})' if named else ''} |"
    yield ""


def _parts(described: type) -> list[type]:
    """Return the types of the fields of a product, or of a part of one, in their order."""
    return list(dict.fromkeys(chain.from_iterable(_parts_of_fields(described).values())))


def _parts_of_fields(described: type) -> dict[str, list[type]]:
    """Return our own classes in the annotation of each field; enumerations by their docstring."""
    if not is_dataclass(described):
        return {}
    module = sys.modules[described.__module__]
    named = dict(re.findall(r"^ +(\w+): .*int\d+ `(\w+)`", described.__doc__ or "", re.MULTILINE))
    found: dict[str, list[type]] = {}
    for name, hint in get_type_hints(described).items():
        inside = [one for one in _flat(hint) if is_dataclass(one) or _is_numbered(one)]
        if name in named:
            inside.append(getattr(module, named[name], None))
        found[name] = [one for one in inside if isinstance(one, type)]
    return found


def _is_numbered(hint: object) -> bool:
    return isinstance(hint, type) and issubclass(hint, IntEnum)


def _flat(hint: object) -> Iterator[object]:
    if get_origin(hint) is ClassVar:
        return
    yield hint
    for inner in get_args(hint):
        yield from _flat(inner)


def _loaded(target: str) -> type:
    module, _, name = target.partition(":")
    found: type = getattr(import_module(module), name)
    return found


def _metrics(catalog: Catalog) -> Iterator[str]:
    yield (
        "# Metrics\n\nMetrics are the numbers that methods report. The prefix `all_` means over "
        "all walls, `wall_<k>_` for that wall, `floor_` for the intensity compared with itself. "
        "On a wall, `x` and `u` point right and `y` and `v` down, as seen by a viewer in front of "
        "it; in a photo, `u` and `v` are columns and rows.\n"
    )
    declared: dict[MetricSpec, list[str]] = {}
    for name in sorted(catalog.methods):
        for spec in catalog.method(name).load().metric_specs():
            declared.setdefault(replace(spec, needs=()), []).append(name)
    for kind in sorted({name.partition(".")[0] for names in declared.values() for name in names}):
        yield f"## {kind}\n\n{_METRICS_HEAD}"
        for spec, names in declared.items():
            own = [name for name in names if name.partition(".")[0] == kind]
            if own and not spec.name.startswith(("all_", "floor_", "wall_", "*_")):
                yield _metric(spec, own)
        yield ""
    yield f"## every step\n\n{_METRICS_HEAD}"
    for name, cost in COSTS.items():
        yield f"| `{name}` | {cost.label} | {cost.unit} | {_good(cost.better)} | all |"
    yield ""


def _metric(spec: MetricSpec, methods: list[str]) -> str:
    label = re.sub(r"\{\d\}", "...", spec.label) or spec.name
    words = f"{label}: {spec.description}" if spec.description else label
    unit = "" if spec.unit == "1" else spec.unit
    return f"| `{spec.name}` | {words} | {unit} | {_good(spec.better)} | {', '.join(methods)} |"


def _good(better: str) -> str:
    return BETTER.get(better, "")


def _commands() -> Iterator[str]:
    yield (
        "# Commands\n\n`orthoflow COMMAND --help` prints the same. For completion of commands, "
        "options and files, add this to `~/.bashrc` (for other shells, use `zsh_source` and "
        "`~/.zshrc`, or `fish_source`):\n\n"
        '```sh\neval "$(_ORTHOFLOW_COMPLETE=bash_source orthoflow)"\n```\n'
    )
    settings = program.context_settings
    with click.Context(program, info_name="orthoflow", terminal_width=100, **settings) as context:
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


def limits() -> Iterator[tuple[str, str, str]]:
    """Yield module, name and meaning of each limit; the meaning is empty without a comment."""
    for package, folder in _LIMITED.items():
        for path in sorted(folder.rglob("*.py")):
            module = ".".join((package, *path.relative_to(folder).with_suffix("").parts))
            for found in _LIMIT.finditer(path.read_text(encoding="utf-8")):
                yield module, found["name"], found["what"] or ""


def _limits() -> Iterator[str]:
    yield (
        "# Limits\n\nThis page lists the maximum sizes and counts that a file may request. A file "
        "that exceeds them is rejected with a message before memory or time is spent on it, "
        "because a few kilobytes could otherwise demand gigabytes or hours. Numbers in files are "
        "also compared with the size of the file. If a valid file exceeds a limit, change the "
        "constant and report it; `ORTHOFLOW_FUZZ_CASES=1000 python -m pytest tests/fuzz` tests the "
        "limits with damaged files.\n\n"
        "| maximum | quantity | constant |\n|---:|---|---|"
    )
    for module, name, what in limits():
        if what:
            value = getattr(import_module(module), name)
            yield f"| {value:,} | {_cell(what)} | `{module}.{name}` |"
    yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def build(output: Path) -> None:
    """Build the site; a broken link is an error."""
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
            raise SystemExit("the site has errors (see above)")
    # Browsers do not let scripts read the search index from a local file.
    for page in output.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        page.write_text(text.replace("</head>", f"{_NO_SEARCH}</head>", 1), encoding="utf-8")
    sys.stdout.write(
        f"open {output / 'index.html'}; the search needs: python -m http.server -d {output}\n"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("site"))
    build(parser.parse_args().output)
