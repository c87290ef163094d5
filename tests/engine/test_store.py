"""The store keeps what is whole, and nothing else."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from orthoflow.engine.cleaning import Soundness, check_store, collect_garbage
from orthoflow.engine.durability import with_digest
from orthoflow.engine.results import CellResult, FigureRef, Metric, ProductRef
from orthoflow.engine.store import Store, digest_of, list_results
from orthoflow.errors import ArgumentError, DamageError, ProductError, StoreError
from orthoflow.products.product import Product
from tests.report_runs import environment

PREIMAGE = '{"v":1}'
KEY = hashlib.sha256(PREIMAGE.encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Heights(Product):
    type_name: ClassVar[str] = "heights"
    values: NDArray[np.float64]
    note: str = ""


def heights(note: str = "", n: int = 2000) -> Heights:
    return Heights(values=np.linspace(0.0, 1.0, n), note=note)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def use(store: Store) -> None:
    with store.in_use():
        pass


def ok_result(store: Store, *products: Product, key: str = KEY) -> CellResult:
    refs = {f"p{index}": store.put_product(item) for index, item in enumerate(products)}
    return CellResult(
        status="ok", key=key, key_preimage=PREIMAGE, method="toy.make", run_id="r1", outputs=refs
    )


def object_folder(store: Store, ref: ProductRef) -> Path:
    return store.objects / ref.digest.removeprefix("sha256:")


def flip_middle(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def test_a_product_comes_back_equal_and_read_only(store: Store) -> None:
    product = heights("first")
    ref = store.put_product(product)
    back = store.get_product(ref.digest, Heights)
    np.testing.assert_array_equal(back.values, product.values)
    assert back.note == "first"
    assert ref == ProductRef(type_name="heights", encoding_version=1, digest=digest_of(product))
    with pytest.raises(ValueError, match="read-only"):
        back.values[0] = 1.0


def publish_link(product: Product, folder: Path, digest: str, /) -> None:
    (folder / "link.txt").symlink_to("/etc/hostname")


def publish_note(product: Product, folder: Path, digest: str, /) -> None:
    (folder / "note.txt").write_text(digest)


def publish_control(product: Product, folder: Path, digest: str, /) -> None:
    (folder / "a\x1b[2J.txt").write_text(digest)


def test_what_cannot_be_published_everywhere_is_refused(store: Store) -> None:
    for publisher, sentence in (
        (publish_link, "a heights publishes 'link.txt', which is a link or a device"),
        (publish_control, r"publishes 'a\\x1b\[2J.txt', which contains a control character"),
    ):
        with pytest.raises(ProductError, match=sentence):
            store.put_product(heights(), publisher)
        assert not list(store.objects.glob("*"))


def test_a_damaged_product_is_replaced_when_it_is_computed_again(store: Store) -> None:
    for damage in (flip_middle, Path.unlink):
        ref = store.put_product(heights())
        damage(object_folder(store, ref) / "product.h5")
        assert store.put_product(heights()) == ref
        stored = store.get_product(ref.digest, Heights)
        np.testing.assert_array_equal(stored.values, heights().values)


def test_an_equal_object_of_another_run_is_left_in_place(store: Store) -> None:
    """The other run may read it: publishing takes long enough for both to have found none."""
    other = Store(store.folder)

    first: list[int] = []

    def publish_twice(product: Product, folder: Path, digest: str, /) -> None:
        ref = other.put_product(product, publish_note)
        first.append(object_folder(store, ref).stat().st_ino)
        publish_note(product, folder, digest)

    ref = store.put_product(heights(), publish_twice)
    assert [object_folder(store, ref).stat().st_ino] == first
    assert not list((store.scratch / "loose").iterdir())


def test_reading_a_damaged_product_says_so_and_removes_it(store: Store) -> None:
    ref = store.put_product(heights())
    flip_middle(object_folder(store, ref) / "product.h5")
    with pytest.raises(DamageError, match=r"was damaged; run again to recompute it"):
        store.get_product(ref.digest, Heights)
    assert not object_folder(store, ref).exists()
    with pytest.raises(DamageError, match="has no product sha256:"):
        store.get_product(ref.digest, Heights)


def test_figures_are_kept_by_their_bytes(store: Store) -> None:
    sha256 = store.put_blob(b"\x89PNG...")
    assert store.put_blob(b"\x89PNG...") == sha256
    assert store.blob(sha256) == b"\x89PNG..."
    with pytest.raises(DamageError, match=r"the figure 000000000000 in the store .* is damaged"):
        store.blob("00" * 32)


def test_a_result_comes_back_equal(store: Store) -> None:
    sha256 = store.put_blob(b"\x89PNG")
    figure = FigureRef(name="f", caption="c", media_type="image/png", sha256=sha256)
    result = dataclasses.replace(
        ok_result(store, heights()),
        citations=("doi:1",),
        warnings=("half of it is missing",),
        log="λ\nline",
        metrics=(Metric(name="rms_mm", value=0.1, unit="mm"),),
        figures=(figure,),
        environment=environment(),
        seed=2**53 - 1,
    )
    store.put_result(KEY, result)
    assert store.result(KEY) == result


def test_an_unreadable_result_is_a_miss(store: Store) -> None:
    store.put_result(KEY, ok_result(store, heights()))
    shape = json.dumps({"format": "orthoflow/result/1", "status": "great"})
    for text in ("", '{"format": "orthoflow/result/9"}', shape, with_digest(shape)):
        (store.results / f"{KEY}.json").write_text(text)
        assert store.result(KEY) is None


def test_a_disk_that_cannot_be_read_is_no_damage(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref = store.put_product(heights("low"))
    assert store.get_product(ref.digest, Heights).note == "low"

    for error, error_class in (
        (OSError(errno.EMFILE, "Too many open files"), StoreError),
        (OSError(errno.EIO, "Input/output error"), DamageError),
        (KeyError("metadata"), DamageError),
    ):
        read = Mock(side_effect=error)
        monkeypatch.setattr("orthoflow_provenance.arrays.read_product_file", read)
        with pytest.raises(error_class) as caught:
            store.get_product(ref.digest, Heights)
        assert isinstance(caught.value, DamageError) is (error_class is DamageError)


# Garbage ------------------------------------------------------------------------------------------


def test_garbage_collection_keeps_exactly_what_results_need(store: Store) -> None:
    with store.in_use():
        kept = ok_result(store, heights("kept"))
        store.put_result(KEY, kept)
        lost = ok_result(store, heights("lost"), key="cd" * 32)
        store.put_result("cd" * 32, lost)
    (object_folder(store, lost.outputs["p0"]) / "product.h5").unlink()
    store.put_product(heights("nobody needs me"))
    (store.scratch / "left-over").mkdir()
    expected = collect_garbage(store, dry_run=True)
    assert (expected.n_results, expected.n_objects) == (1, 2)
    assert expected.freed_bytes > 0
    assert store.result(KEY) == kept
    assert collect_garbage(store) == expected
    assert store.result(KEY) == kept
    assert [path.name for path in store.objects.iterdir()] == [kept.outputs["p0"].digest[7:]]
    assert list(store.scratch.iterdir()) == []
    assert [item.key for item in store.earlier_results("toy.make")] == [KEY]
    assert store.earlier_results("toy.other") == ()


def test_garbage_collection_removes_what_was_not_used_for_long(store: Store) -> None:
    with store.in_use():
        for key in (KEY, "cd" * 32):
            store.put_result(key, ok_result(store, heights(key), key=key))
    old = time.time() - 10 * 86400
    os.utime(store.results / f"{KEY}.json", (old, old))
    assert collect_garbage(store, older_than_days=5).n_results == 1
    assert store.result(KEY) is None
    assert store.result("cd" * 32) is not None
    assert collect_garbage(store, older_than_days=0).n_results == 1
    assert list(store.objects.iterdir()) == []


def test_garbage_collection_refuses_while_a_run_uses_the_store(store: Store) -> None:
    refusal = pytest.raises(StoreError, match="is in use by a run; wait until it has ended")
    with store.in_use(), store.in_use(), refusal:
        collect_garbage(store)
    assert collect_garbage(store).n_results == 0


def test_a_store_is_listed_and_checked(store: Store) -> None:
    assert collect_garbage(store).freed_bytes == 0
    assert not store.folder.exists()
    with pytest.raises(ArgumentError, match="days must be 0 or more, got -1"):
        collect_garbage(store, older_than_days=-1)
    assert list_results(store) == ()
    assert check_store(store) == Soundness(n_results=0, n_objects=0, damaged=())
    result = ok_result(store, heights())
    store.put_result(KEY, result)
    (item,) = list_results(store)
    folder = object_folder(store, result.outputs["p0"])
    size = sum(path.stat().st_size for path in folder.iterdir())
    listed = (item.key, item.method, item.run_id, item.size_bytes, item.is_complete)
    assert listed == (KEY, "toy.make", "r1", size, True)
    # What others put there is not ours.
    (store.objects / "notes").mkdir()
    (store.results / "notes.txt").touch()
    assert check_store(store) == Soundness(n_results=1, n_objects=1, damaged=())
    assert store.is_sound(result.outputs["p0"].digest)
    shutil.rmtree(folder)
    (damage,) = check_store(store).damaged
    assert damage.name == f"results/{KEY}.json"


@pytest.mark.parametrize("command", [use, collect_garbage, check_store])
def test_a_folder_of_something_else_is_refused_and_left_as_it_was(
    tmp_path: Path, command: Callable[[Store], object]
) -> None:
    """What looks like a store to whoever looks at `objects` alone."""
    folder = tmp_path / ".git"
    (folder / "objects" / "ab").mkdir(parents=True)
    (folder / "objects" / "ab" / "cd").write_bytes(b"precious")
    (folder / "results").mkdir()
    (folder / "HEAD").write_text("ref: refs/heads/main")
    before = {path: path.is_dir() or path.read_bytes() for path in folder.rglob("*")}
    with pytest.raises(
        ArgumentError, match=r"\.git is not a store of orthoflow: it contains HEAD; give"
    ):
        command(Store(folder))
    assert {path: path.is_dir() or path.read_bytes() for path in folder.rglob("*")} == before
    (folder / "refs").mkdir()
    with pytest.raises(ArgumentError, match=r"it contains HEAD and 1 more;"):
        command(Store(folder))
