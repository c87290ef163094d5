"""The catalog: look-ups of methods, kinds and product types by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

from orthoflow.catalog.entries import BrokenPlugin, KindEntry, MethodEntry, ProductEntry
from orthoflow.catalog.suggestions import did_you_mean, nearest
from orthoflow.errors import PluginError, WorkflowError

if TYPE_CHECKING:
    from orthoflow.products.product import Product

    class Publisher(Protocol):
        """Writes the files of a product that people open in other programs."""

        def __call__(self, product: Product, folder: Path, digest: str) -> object:
            """Write into an existing folder."""
            raise AssertionError("a protocol is never called")


@dataclass(frozen=True, kw_only=True)
class Catalog:
    """Everything that the installed plugins bring.

    Attributes:
        methods: by id, in the order of announcement.
        kinds: by name.
        products: by type name.
        broken: plugins that failed to load; they spoil only a workflow that needs them.
    """

    methods: Mapping[str, MethodEntry]
    kinds: Mapping[str, KindEntry]
    products: Mapping[str, ProductEntry]
    broken: tuple[BrokenPlugin, ...] = ()

    def method(self, method_id: str) -> MethodEntry:
        """Give a method that can be loaded.

        Raises:
            WorkflowError: nobody brings a method of that id.
            PluginError: several bring it, its kind is unusable, or the plugin that brings it
                fails to load.
        """
        entry = self.methods.get(method_id)
        if entry is None:
            for plugin in self.broken:
                if plugin.mentions(method_id):
                    raise PluginError(f"method {method_id} cannot be used: {plugin}")
            raise WorkflowError(
                f"unknown method {method_id}{self._suggest(method_id)}{self._hint_at_broken()}; "
                f"`orthoflow plugins list` names all"
            )
        if entry.state != "fine":
            raise PluginError(entry.problem)
        return entry

    def product_class(self, type_name: str) -> type[Product]:
        """Give the class of a product type.

        Raises:
            PluginError: nobody brings the type, several do, or it fails to import.
        """
        from orthoflow.catalog.loading import import_target  # noqa: PLC0415 - loads pydantic
        from orthoflow.products.product import Product  # noqa: PLC0415 - loads numpy

        entry = self._product(type_name)
        cls = import_target(entry.spec.target, f"product type {type_name}", entry.distribution)
        if not (isinstance(cls, type) and issubclass(cls, Product)):
            raise PluginError(
                f"product type {type_name} of {entry.distribution} breaks a rule: "
                f"{entry.spec.target} must be a subclass of Product"
            )
        if cls.type_name != type_name:
            raise PluginError(
                f"product type {type_name} of {entry.distribution} breaks a rule: its class says "
                f"{cls.type_name}"
            )
        return cls

    def publisher(self, type_name: str) -> Publisher | None:
        """Give what writes the files of a product type; None when there are none to write.

        Raises:
            PluginError: nobody brings the type, several do, or its publisher fails to import.
        """
        from orthoflow.catalog.loading import import_target  # noqa: PLC0415 - loads pydantic

        entry = self._product(type_name)
        if not entry.spec.publisher:
            return None
        what = f"publisher of {type_name}"
        publish = import_target(entry.spec.publisher, what, entry.distribution)
        if not callable(publish):
            raise PluginError(f"{what} of {entry.distribution} must be a function, got {publish!r}")
        return cast("Publisher", publish)

    def _product(self, type_name: str) -> ProductEntry:
        entry = self.products.get(type_name)
        if entry is None:
            raise PluginError(
                f"no installed plugin brings product type {type_name}"
                f"{did_you_mean(type_name, self.products)}{self._hint_at_broken()}"
            )
        if entry.state != "fine":
            raise PluginError(entry.problem)
        return entry

    def _suggest(self, method_id: str) -> str:
        # Inside a kind only the second part tells names apart; `plane.` is alike in all of them.
        kind, _, name = method_id.partition(".")
        siblings = {other.partition(".")[2]: other for other in self._of_kind(kind)}
        if not siblings:
            return did_you_mean(method_id, self.methods)
        if near := nearest(name, siblings):
            return f" (did you mean {siblings[near]}?)"
        return f"; kind {kind} has {', '.join(siblings.values())}"

    def _of_kind(self, kind: str) -> list[str]:
        return [method for method, entry in self.methods.items() if entry.spec.kind == kind]

    def _hint_at_broken(self) -> str:
        return "".join(f"; {plugin}" for plugin in self.broken)
