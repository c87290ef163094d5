"""Looking at every byte of a store: what is damaged is named and removed, and nothing else."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.engine.cleaning import Damage, Soundness, check_store
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.engine.store import Store
from orthoflow.products.product import Product


@dataclass(frozen=True, kw_only=True)
class Heights(Product):
    type_name: ClassVar[str] = "heights"
    values: NDArray[np.float64]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def kept(store: Store, name: str, value: float) -> tuple[str, ProductRef]:
    """A product in the store, and a result that has it."""
    ref = store.put_product(Heights(values=np.full(300, value)))
    key = hashlib.sha256(name.encode()).hexdigest()
    result = CellResult(
        status="ok", key=key, key_preimage=name, method="a.b", run_id="r1", outputs={"out": ref}
    )
    store.put_result(key, result)
    return key, ref


def test_what_is_sound_is_counted_and_left(store: Store) -> None:
    assert check_store(store) == Soundness(n_results=0, n_objects=0, damaged=())
    key, ref = kept(store, "one", 1.0)
    # What others put there is not ours.
    (store.objects / "notes").mkdir()
    (store.results / "notes.txt").touch()
    assert check_store(store) == Soundness(n_results=1, n_objects=1, damaged=())
    assert store.result(key) is not None
    assert store.is_sound(ref.digest)


def test_a_result_whose_product_is_gone_is_the_damage(store: Store) -> None:
    key, ref = kept(store, "one", 1.0)
    for path in sorted((store.objects / ref.digest.removeprefix("sha256:")).rglob("*")):
        path.unlink()
    (store.objects / ref.digest.removeprefix("sha256:")).rmdir()
    found = check_store(store)
    assert (found.n_results, found.n_objects) == (0, 0)
    (damage,) = found.damaged
    assert isinstance(damage, Damage)
    assert damage.name == f"results/{key}.json"
