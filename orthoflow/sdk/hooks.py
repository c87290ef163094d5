"""Hooks and specs with which a plugin declares its content, without importing numpy or pydantic.

A plugin is an installed distribution with an entry point in the group `orthoflow.plugins`. The
entry point refers to a module that implements one or more of the hooks below with `hookimpl`.
Classes are given as import strings and imported on first use.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import pluggy

PROJECT: Final = "orthoflow"
ENTRY_POINT_GROUP: Final = "orthoflow.plugins"
# Type of a port that is connected to an input of the workflow.
FILES: Final = "files"

hookimpl: Final = pluggy.HookimplMarker(PROJECT)
hookspec: Final = pluggy.HookspecMarker(PROJECT)


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """Declaration of a method.

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
        """The kind: the part of the id before the dot."""
        return self.id.partition(".")[0]


@dataclass(frozen=True, kw_only=True)
class KindSpec:
    """Declaration of a kind, whose methods are interchangeable because they have the same ports.

    Attributes:
        name: name of the kind.
        summary: one line for listings.
        inputs: product type name by port name, or `files` for an input of the workflow; empty for
            sources, whose methods declare their own ports.
        outputs: product type name by port name; empty for sources.
        is_source: whether methods declare their own ports; steps of such a kind have no variants.
    """

    name: str
    summary: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    is_source: bool = False


@dataclass(frozen=True, kw_only=True)
class ProductSpec:
    """Declaration of a product type.

    Attributes:
        type_name: name of the type, e.g. `planes`.
        target: import string of the class.
        summary: one line for listings.
        publisher: import string of a function `publish(product, folder, digest)` that writes files
            for other programs; empty if there is none.
    """

    type_name: str
    target: str
    summary: str
    publisher: str = ""


class PluginHooks:
    """Hooks that a plugin may implement."""

    @hookspec
    def orthoflow_methods(self) -> list[MethodSpec]:
        """Return the methods of the plugin."""
        raise AssertionError("a hook specification is never called")

    @hookspec
    def orthoflow_kinds(self) -> list[KindSpec]:
        """Return the kinds of the plugin."""
        raise AssertionError("a hook specification is never called")

    @hookspec
    def orthoflow_products(self) -> list[ProductSpec]:
        """Return the product types of the plugin."""
        raise AssertionError("a hook specification is never called")
