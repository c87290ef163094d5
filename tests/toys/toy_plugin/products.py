"""Numbers, embedded in records, and scans, which are mapped and are not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from orthoflow.products.product import Product


@dataclass(frozen=True, kw_only=True)
class Numbers(Product):
    type_name: ClassVar[str] = "numbers"
    values: NDArray[np.float64]
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Scan(Product):
    type_name: ClassVar[str] = "scan"
    mapped: ClassVar[bool] = True
    embedded: ClassVar[bool] = False
    values: NDArray[np.float64]


def publish(product: Numbers, folder: Path, digest: str) -> None:
    (folder / "numbers.txt").write_text(f"{digest} {product.values.tolist()}")
