"""What the catalog lists: one entry per method, kind, product type and broken plugin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from orthoflow.catalog.distributions import DistributionInfo, package_path, source_files
from orthoflow.errors import PluginError
from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec

if TYPE_CHECKING:
    from orthoflow.sdk.methods import Method

EntryState = Literal["fine", "broken", "clash"]


@dataclass(frozen=True, kw_only=True)
class BrokenPlugin:
    """A plugin whose hooks cannot be used.

    Attributes:
        entry_point: name of the entry point.
        module: what the entry point names.
        distribution: who brought it.
        error: one line, class and message of what went wrong.
        traceback: for `--debug` and bug reports.
    """

    entry_point: str
    module: str
    distribution: DistributionInfo
    error: str
    traceback: str

    def __str__(self) -> str:
        return f"plugin {self.entry_point} of {self.distribution} fails to load: {self.error}"

    def mentions(self, method_id: str) -> bool:
        """Whether the plugin's code names this method, so that it most likely brings it."""
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
class KindEntry:
    """A kind as announced.

    Attributes:
        spec: ports of the kind.
        distribution: who announced it.
        state: `clash` when two distributions announce it with different ports, `broken` when a
            port carries a product type that nobody announces.
        problem: one sentence, empty when fine.
    """

    spec: KindSpec
    distribution: DistributionInfo
    state: EntryState = "fine"
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class ProductEntry:
    """A product type as announced.

    Attributes:
        spec: where class and publisher are.
        distribution: who announced it.
        state: `clash` when two distributions announce different classes for it.
        problem: one sentence, empty when fine.
    """

    spec: ProductSpec
    distribution: DistributionInfo
    state: EntryState = "fine"
    problem: str = ""


@dataclass(frozen=True, kw_only=True)
class MethodEntry:
    """A method as announced; its class loads on first use.

    Attributes:
        spec: id, import string, summary.
        distribution: who brought it; of a clash, the first claimant.
        kind: ports that the method must keep; None when nobody announces its kind.
        product_types: all product types that ports may carry.
        state: `clash` when several claim the id, `broken` when its kind cannot be used.
        problem: one sentence that names the distributions, empty when fine.
    """

    spec: MethodSpec
    distribution: DistributionInfo
    kind: KindSpec | None
    product_types: frozenset[str] = frozenset()
    state: EntryState = "fine"
    problem: str = ""

    def load(self) -> type[Method]:
        """Import the class and check what the framework relies on.

        Raises:
            PluginError: the entry is not fine, the import fails, or the class breaks a rule; the
                sentence names the distribution.
        """
        if self.state != "fine" or self.kind is None:
            raise PluginError(self.problem)
        from orthoflow.catalog.loading import load_method  # noqa: PLC0415 - loads pydantic

        return load_method(self.spec, self.kind, self.distribution, self.product_types)

    def source_files(self) -> tuple[Path, ...]:
        """Python files whose content can change the method's results, sorted.

        The packages of the hooks and of the class; they matter when `distribution.is_released` is
        False. Never empty for a method that loads from files.
        """
        return source_files(
            (self.distribution.source_folder, package_path(self.spec.target.partition(":")[0]))
        )
