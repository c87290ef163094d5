"""The files of a new plugin, written from templates and the ports of its kind."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import jinja2

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.errors import ArgumentError, did_you_mean
from orthoflow.scaffold.comparing import comparison_text, own_comparison_text
from orthoflow.scaffold.kinds import kind_ports
from orthoflow.version import __version__

_TEMPLATES: Final = Path(__file__).parent / "templates"
_NAME: Final = re.compile(r"[a-z][a-z0-9-]{1,31}")


@dataclass(frozen=True, kw_only=True)
class Project:
    """Description of a new plugin, given by its author.

    Attributes:
        name: name of the distribution and the method, e.g. `my-detector`.
        kind: kind of its method, which is either a kind of an installed plugin or a new one.
        takes: product types of the inputs of a new kind.
        gives: existing product types of the outputs of a new kind; empty for an existing kind.
        product: name of a new product type, which the new kind also outputs; empty if there is
            none.
    """

    name: str
    kind: str
    takes: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    product: str = ""

    @property
    def is_new_kind(self) -> bool:
        """Whether the plugin provides the kind of its method."""
        return bool(self.product or self.gives)

    @property
    def package(self) -> str:
        """Name of the Python package."""
        return self.name.replace("-", "_")

    @property
    def method_id(self) -> str:
        """Id of the method."""
        return f"{self.kind}.{self.name}"

    @property
    def class_name(self) -> str:
        """Name of the method's class."""
        return f"{_class_name(self.name)}Method"

    @property
    def product_class(self) -> str:
        """Name of the class of the new product."""
        return f"{_class_name(self.product)}Product"


def _class_name(name: str) -> str:
    return "".join(part.capitalize() for part in re.split("[-_]", name))


def write_project(project: Project, parent: Path, catalog: Catalog) -> tuple[Path, ...]:
    """Write a new plugin into a new folder.

    Args:
        project: description of the plugin.
        parent: parent of the new folder.
        catalog: the installed plugins.

    Returns:
        The files written, as paths relative to `parent`.

    Raises:
        ArgumentError: the name or kind is not allowed, or the folder already exists.
    """
    folder = parent / project.name
    _check(project, folder, catalog)
    written: list[Path] = []
    for name, text in _files(project, catalog):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        written.append(path.relative_to(parent))
    return tuple(written)


def _check(project: Project, folder: Path, catalog: Catalog) -> None:
    if not _NAME.fullmatch(project.name) or keyword.iskeyword(project.package):
        raise ArgumentError(
            "a plugin's name must consist of 2 to 32 lower-case letters, digits and hyphens, start "
            "with a letter, and not be a Python keyword, e.g. my-detector, got "
            f"{project.name!r}"
        )
    if project.is_new_kind:
        _check_new_kind(project, catalog)
    elif project.kind not in catalog.kinds:
        raise ArgumentError(
            f"no installed plugin declares the kind {project.kind}"
            f"{did_you_mean(project.kind, catalog.kinds)}; kinds: {', '.join(catalog.kinds)}"
        )
    if taken := catalog.methods.get(project.method_id):
        raise ArgumentError(
            f"{taken.distribution} already provides the method {project.method_id}; choose another "
            "name"
        )
    if find_spec(project.package) is not None:
        raise ArgumentError(
            f"a Python package {project.package} is already installed; choose another name"
        )
    if folder.exists():
        raise ArgumentError(f"{folder} already exists; choose another name, or remove it")


def _check_new_kind(project: Project, catalog: Catalog) -> None:
    if project.kind in catalog.kinds:
        raise ArgumentError(
            f"kind {project.kind} is already declared by an installed plugin: write a method of "
            f"this kind with --kind {project.kind}, or choose another name"
        )
    for name in filter(None, (project.kind, project.product)):
        if not re.fullmatch(NAME_PATTERN, name) or keyword.iskeyword(name) or "-" in name:
            raise ArgumentError(
                "names of kinds and products must consist of lower-case letters, digits and "
                f"underscores, got {name!r}"
            )
    if project.product in catalog.products:
        raise ArgumentError(
            f"product {project.product} is already registered: choose another name with --gives"
        )
    for name in (*project.takes, *project.gives):
        if name not in catalog.products:
            raise ArgumentError(
                f"there is no product type {name}{did_you_mean(name, catalog.products)}; types: "
                f"{', '.join(catalog.products)}"
            )


def _files(project: Project, catalog: Catalog) -> Iterator[tuple[str, str]]:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    comparison, method = "", "method.py.jinja"
    if project.product:
        method = "own_method.py.jinja"
        comparison = own_comparison_text(project.method_id, project.takes, catalog)
    elif not project.is_new_kind:
        if (_TEMPLATES / (written := f"kinds/{project.kind}.py.jinja")).is_file():
            method = written
        comparison = comparison_text(project.method_id, project.name, catalog)
    known = {
        "project": project,
        "ports": kind_ports(catalog, project.kind, project.takes, project.gives),
        "version": __version__,
        "has_comparison": bool(comparison),
        "outputs": [*filter(None, [project.product]), *project.gives],
    }
    yield f"{project.package}/method.py", environment.get_template(method).render(known)
    for template in environment.list_templates():
        name = template.removeprefix("project/").removesuffix(".jinja")
        if name != template.removesuffix(".jinja") and (project.product or "product" not in name):
            text = environment.get_template(template).render(known)
            yield name.replace("package/", f"{project.package}/"), text
    if comparison:
        yield "compare.yaml", comparison
