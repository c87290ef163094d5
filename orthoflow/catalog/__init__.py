"""What is installed: methods, kinds and product types of all plugins, and what is wrong with them.

Light on purpose: nothing here loads numpy, pydantic or networkx until a method is loaded.
"""

from __future__ import annotations

from orthoflow.catalog.catalog import (
    BrokenPlugin,
    Catalog,
    EntryState,
    KindEntry,
    MethodEntry,
    ProductEntry,
)
from orthoflow.catalog.discovery import NAME_PATTERN, discover_catalog
from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.catalog.wording import did_you_mean, nearest

__all__ = [
    "NAME_PATTERN",
    "BrokenPlugin",
    "Catalog",
    "DistributionInfo",
    "EntryState",
    "KindEntry",
    "MethodEntry",
    "ProductEntry",
    "did_you_mean",
    "discover_catalog",
    "nearest",
]
