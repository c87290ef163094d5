"""What a plugin announces: hooks and specs. Light on purpose: no numpy, no pydantic.

A plugin is an installed distribution with an entry point in the group `orthoflow.plugins` that
names a module; the module implements one or more of the hooks below with `hookimpl`. Classes are
named by import strings and loaded on first use.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import pluggy

PROJECT: Final = "orthoflow"
ENTRY_POINT_GROUP: Final = "orthoflow.plugins"
# What a port takes that is wired to an input of the workflow itself.
FILES: Final = "files"

hookimpl: Final = pluggy.HookimplMarker(PROJECT)
hookspec: Final = pluggy.HookspecMarker(PROJECT)


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """Where a method's class is.

    Attributes:
        id: `kind.method`, e.g. `plane.hough2d`.
        target: import string `package.module:Class`.
        summary: one line for listings.
    """

    id: str
    target: str
    summary: str

    @property
    def kind(self) -> str:
        """The kind, the part of the id before the dot."""
        return self.id.partition(".")[0]


@dataclass(frozen=True, kw_only=True)
class KindSpec:
    """Ports that all methods of a kind share, so that they are interchangeable.

    Attributes:
        name: the kind.
        summary: one line for listings.
        inputs: port name -> product type name, or `files` for an input of the workflow; empty for
            sources, whose methods have their own.
        outputs: port name -> product type name; likewise.
        is_source: methods declare ports of their own and take no variants.
    """

    name: str
    summary: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    is_source: bool = False


@dataclass(frozen=True, kw_only=True)
class ProductSpec:
    """Where a product type's class is, and what writes its files.

    Attributes:
        type_name: name of the type, e.g. `planes`.
        target: import string of the class.
        summary: one line for listings.
        publisher: import string of `publish(product, folder, digest)`, which writes the files
            that people open in other programs; empty when there are none.
    """

    type_name: str
    target: str
    summary: str
    publisher: str = ""


class PluginHooks:
    """The hooks a plugin may implement."""

    @hookspec
    def orthoflow_methods(self) -> list[MethodSpec]:
        """Methods that the plugin brings."""
        raise AssertionError("a hook specification is never called")

    @hookspec
    def orthoflow_kinds(self) -> list[KindSpec]:
        """Kinds that the plugin brings."""
        raise AssertionError("a hook specification is never called")

    @hookspec
    def orthoflow_products(self) -> list[ProductSpec]:
        """Product types that the plugin brings."""
        raise AssertionError("a hook specification is never called")
