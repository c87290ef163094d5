"""The catalog: methods, kinds, product types and broken plugins, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Protocol, cast

from orthoflow.catalog.distributions import (
    DistributionInfo,
    package_path,
    source_files,
)
from orthoflow.errors import PluginError, WorkflowError, did_you_mean, nearest
from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec
from orthoflow.version import DISTRIBUTION

if TYPE_CHECKING:
    from orthoflow.products.product import Product
    from orthoflow.sdk.methods import Method

    class Publisher(Protocol):
        """Writes the files of a product for other programs."""

        def __call__(self, product: Product, folder: Path, digest: str) -> object:
            """Write the files to an existing folder."""


EntryState = Literal["fine", "broken", "clash"]
# Environment variable with the distributions or entry points of disabled plugins, separated by
# commas.
DISABLED: Final = "ORTHOFLOW_DISABLED_PLUGINS"


@dataclass(frozen=True, kw_only=True)
class BrokenPlugin:
    """A plugin whose hooks cannot be used.

    Attributes:
        entry_point: name of the entry point.
        module: module to which the entry point refers.
        distribution: distribution that contains it.
        error: class and message of the error, one line.
        traceback: traceback for `--debug` and bug reports.
    """

    entry_point: str
    module: str
    distribution: DistributionInfo
    error: str
    traceback: str

    def __str__(self) -> str:
        return f"plugin {self.entry_point} of {self.distribution} cannot be loaded: {self.error}"

    def mentions(self, method_id: str) -> bool:
        """Return whether the plugin's code contains this method id, and so may declare it."""
        quoted = (f'"{method_id}"', f"'{method_id}'")
        for path in source_files((package_path(self.module.partition(":")[0]),)):
            try:
                text = path.read_text(encoding="utf-8", errors="replace")
            except OSError:
                continue
            if any(mark in text for mark in quoted):
                return True
        return False


@dataclass(frozen=True, kw_only=True)
class Announced:
    """Origin and state of an entry.

    Attributes:
        distribution: distribution that declares the entry; the first one if several do.
        state: `clash` if several distributions declare the entry and none takes precedence;
            `broken` if it cannot be used.
        problem: one sentence that names the distributions concerned; also set for a usable entry
            that several distributions declare differently.
    """

    distribution: DistributionInfo
    state: EntryState = "fine"
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class KindEntry(Announced):
    """A kind; broken if no plugin declares the product type of one of its ports."""

    spec: KindSpec


@dataclass(frozen=True, kw_only=True)
class ProductEntry(Announced):
    """A product type, with the import strings of its class and its publisher."""

    spec: ProductSpec


@dataclass(frozen=True, kw_only=True)
class MethodEntry(Announced):
    """A method, whose class is loaded on first use; broken if its kind cannot be used.

    Attributes:
        spec: id, import string and summary.
        kind: kind with the ports of the method; None if no plugin declares it.
        product_types: all product types that ports may have.
    """

    spec: MethodSpec
    kind: KindSpec | None
    product_types: frozenset[str] = frozenset()

    def load(self) -> type[Method]:
        """Import the class on the first call, and check the rules on which the framework relies.

        Raises:
            PluginError: the entry is not usable, the import fails, or the class violates a rule;
                the message names the distribution.
        """
        return self._loaded

    @cached_property
    def _loaded(self) -> type[Method]:
        if self.state != "fine" or self.kind is None:
            raise PluginError(self.problem)
        from orthoflow.catalog.loading import load_method  # noqa: PLC0415 - loads pydantic

        return load_method(self.spec, self.kind, self.distribution, self.product_types)

    def looked_at(self) -> MethodEntry:
        """Return the entry, with the state `broken` if its class cannot be loaded.

        Built-in methods are not loaded, which saves half a second; the tests of each release load
        them.
        """
        if self.state != "fine" or self.distribution.name == DISTRIBUTION:
            return self
        try:
            self.load()
        except PluginError as error:
            return replace(self, state="broken", problem=str(error))
        return self

    def source_files(self) -> tuple[Path, ...]:
        """Return the Python files whose content can change the results of the method, sorted.

        These are all files in the packages of the hooks and of the class.
        """
        return source_files(
            (self.distribution.source_folder, package_path(self.spec.target.partition(":")[0]))
        )


@dataclass(frozen=True, kw_only=True)
class Catalog:
    """Content of the installed plugins.

    Attributes:
        methods: methods by id, in the order of declaration.
        kinds: kinds by name.
        products: product types by name.
        broken: plugins that failed to load; they affect only workflows that need them.
        disabled: names of plugins that are disabled by the environment variable.
    """

    methods: Mapping[str, MethodEntry]
    kinds: Mapping[str, KindEntry]
    products: Mapping[str, ProductEntry]
    broken: tuple[BrokenPlugin, ...] = ()
    disabled: tuple[str, ...] = ()

    def method(self, method_id: str) -> MethodEntry:
        """Return the entry of a usable method.

        Raises:
            WorkflowError: no plugin has a method with that id.
            PluginError: several plugins declare it, its kind is unusable, or its plugin fails to
                load.
        """
        entry = self.methods.get(method_id)
        if entry is None:
            for plugin in self.broken:
                if plugin.mentions(method_id):
                    raise PluginError(f"method {method_id} cannot be used: {plugin}")
            raise WorkflowError(
                f"unknown method {method_id}{self._suggest(method_id)}{self._hint_at_broken()}; "
                "`orthoflow plugins list` shows all; to add the methods of your own plugin, run "
                "`pip install -e .` in its folder"
            )
        if entry.state != "fine":
            raise PluginError(entry.problem)
        return entry

    def product_class(self, type_name: str) -> type[Product]:
        """Return the class of a product type.

        Raises:
            PluginError: no plugin declares the type, or its class cannot be imported or is invalid.
        """
        from orthoflow.catalog.loading import import_target  # noqa: PLC0415 - loads pydantic
        from orthoflow.products.product import Product  # noqa: PLC0415 - loads numpy

        entry = self._product(type_name)
        cls = import_target(entry.spec.target, f"product type {type_name}", entry.distribution)
        broken = f"product type {type_name} of {entry.distribution} is invalid: "
        if not (isinstance(cls, type) and issubclass(cls, Product)):
            raise PluginError(f"{broken}{entry.spec.target} must be a subclass of Product")
        own = getattr(cls, "type_name", None)
        if own != type_name:
            raise PluginError(
                f"{broken}the type_name of {entry.spec.target} must be {type_name}, got {own!r}"
            )
        return cls

    def publisher(self, type_name: str) -> Publisher | None:
        """Return the publisher of a product type; None if it has none.

        Raises:
            PluginError: no plugin declares the type, or its publisher cannot be imported.
        """
        from orthoflow.catalog.loading import import_target  # noqa: PLC0415 - loads pydantic

        entry = self._product(type_name)
        if not entry.spec.publisher:
            return None
        publish = import_target(
            entry.spec.publisher, f"publisher of {type_name}", entry.distribution
        )
        return cast("Publisher", publish)

    def _product(self, type_name: str) -> ProductEntry:
        entry = self.products.get(type_name)
        if entry is None:
            raise PluginError(
                "no installed plugin provides the product type "
                f"{type_name}{did_you_mean(type_name, self.products)}{self._hint_at_broken()}"
            )
        if entry.state != "fine":
            raise PluginError(entry.problem)
        return entry

    def _suggest(self, method_id: str) -> str:
        # Compare only the part after the dot, since the part before it is the same for all
        # candidates.
        kind, _, name = method_id.partition(".")
        siblings = {other.partition(".")[2]: other for other in self._of_kind(kind)}
        if not siblings:
            same = [other for other in self.methods if other.partition(".")[2] == method_id]
            if same:
                return f" (did you mean {' or '.join(same)}?)"
            return did_you_mean(method_id, self.methods)
        if near := nearest(name, siblings):
            return f" (did you mean {siblings[near]}?)"
        return f"; kind {kind} has {', '.join(siblings.values())}"

    def _of_kind(self, kind: str) -> list[str]:
        return [method for method, entry in self.methods.items() if entry.spec.kind == kind]

    def _hint_at_broken(self) -> str:
        hints = [f"; {plugin}" for plugin in self.broken]
        if self.disabled:
            hints.append(f"; {DISABLED} disables {', '.join(self.disabled)}")
        return "".join(hints)
