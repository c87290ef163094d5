"""The store: products by digest, results by key; the engine's only door to the record format.

Layout below the store's folder:

    objects/<digest>/product.h5     a product, `object.json` beside it, `files/` what it publishes
    objects/<digest>/blob           a figure
    results/<key>.json              what a cell gave, naming objects
    preimages/<method>/<key>.json   small copies of the keys' preimages, for explanations
    digests.json                    memory of input files' digests; disposable
    numba/<source digest>/          compiled kernels; disposable
    scratch/<run id>/               work in progress; removed with its run
    lock                            shared by runs, exclusive for garbage collection
"""

from __future__ import annotations

import contextlib
import filecmp
import hashlib
import json
import os
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from orthoflow_provenance.digests import canonical_json, payload_digest
from orthoflow_provenance.errors import RecordFormatError

from orthoflow.engine.clock import time_of_file
from orthoflow.engine.durability import (
    folder_size,
    place_folder,
    remove_tree,
    sync_file,
    sync_folder,
    write_whole,
    writing_to,
)
from orthoflow.engine.file_digests import FileDigests
from orthoflow.engine.locks import shared_lock
from orthoflow.engine.results import (
    CellResult,
    ProductRef,
    result_from_json,
    result_to_json,
)
from orthoflow.errors import ProductError, StoreError
from orthoflow.products.product import Payload, Product

if TYPE_CHECKING:
    from orthoflow_provenance.payloads import StoredPayload

__all__ = [
    "Preimage",
    "Publisher",
    "Store",
    "StoredResult",
    "canonical_json",
    "digest_of",
    "list_results",
]

_HDF5_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_READ_RETRY_S: Final = 0.05

ProductT = TypeVar("ProductT", bound=Product)


class Publisher(Protocol):
    """What writes the files of a product that people open in other programs."""

    def __call__(self, product: Product, folder: Path, digest: str, /) -> object:
        """Write the files into an existing empty folder."""
        raise AssertionError("a protocol is never called")


@dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A result in the store.

    Attributes:
        key: cache key.
        method: method id.
        run_id: the run that computed it.
        ended: ISO 8601 UTC.
        last_used: ISO 8601 UTC, when a run last took or made it.
        size_bytes: of its products with their published files; equal products of several results
            count for each.
        is_complete: all its products and figures are there.
    """

    key: str
    method: str
    run_id: str
    ended: str
    last_used: str
    size_bytes: int
    is_complete: bool


@dataclass(frozen=True, kw_only=True)
class Preimage:
    """Key preimage of an earlier result, with the name of its step."""

    key: str
    step: str
    text: str


class Store:
    """A folder of products and results that runs share, also at the same time.

    Nothing half written is ever taken as valid: every file and folder is made aside, synced and
    renamed into place.
    """

    def __init__(self, folder: Path, *, workspace: Path | None = None) -> None:
        """Name a store; nothing is touched before something is written.

        Args:
            folder: the store's folder.
            workspace: where unfinished objects lie, on the same file system; below the store's
                scratch folder when not given.
        """
        self.folder = Path(folder).absolute()
        self.scratch = self.folder / "scratch"
        self.results = self.folder / "results"
        self.objects = self.folder / "objects"
        self.preimages = self.folder / "preimages"
        self.lock_file = self.folder / "lock"
        self._workspace = workspace or self.scratch / "loose"

    def file_digests(self) -> FileDigests:
        """Give the memory of input files' digests; call its `save` when done."""
        return FileDigests(self.folder / "digests.json")

    def numba_folder(self, source_digest: str) -> Path:
        """Where kernels compiled from this source are kept."""
        return self.folder / "numba" / source_digest[:32]

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Keep garbage collection away.

        Raises:
            StoreError: the store's folder cannot be made.
        """
        with writing_to(self.folder):
            for folder in (self.scratch, self.results, self.objects, self.preimages):
                folder.mkdir(parents=True, exist_ok=True)
            ignore = self.folder / ".gitignore"
            if not ignore.exists():
                ignore.write_text("*\n", encoding="utf-8")
        with shared_lock(self.lock_file):
            yield

    # Products -----------------------------------------------------------------------------------

    def put_product(
        self, product: Product, publisher: Publisher | None = None, *, publisher_tag: str = ""
    ) -> ProductRef:
        """Keep a product and the files it publishes.

        Args:
            product: what to keep; an equal one that is there already stays.
            publisher: writes its published files.
            publisher_tag: version of the publisher; files of another version are made anew.

        Raises:
            StoreError: full disk, or another failure of the disk.
            ProductError: the product holds what no store can keep.
        """
        # Loads h5py, which a plan does without.
        from orthoflow_provenance.payloads import write_product_file  # noqa: PLC0415

        aside = self._new_folder()
        try:
            with writing_to(self.folder):
                digest = write_product_file(aside / "product.h5", product.to_payload())
                final = self._object(digest)
                if not _is_same_object(aside, final, publisher_tag if publisher else ""):
                    self._finish_object(aside, product, publisher, digest)
                    _describe(aside, type(product).type_name, publisher_tag if publisher else "")
                    self._place(aside, final)
        except RecordFormatError as error:
            raise ProductError(f"a {product.type_name} cannot be stored: {error}") from error
        finally:
            remove_tree(aside)
        return ProductRef(
            type_name=product.type_name, encoding_version=product.encoding_version, digest=digest
        )

    def get_product(self, digest: str, cls: type[ProductT]) -> ProductT:
        """Read a product; arrays are read-only, those of scan size memory-mapped.

        Raises:
            StoreError: it is not there, or was damaged; a damaged one is removed.
            ProductError: it is of another type.
        """
        from orthoflow_provenance.payloads import read_product_file  # noqa: PLC0415 - as above

        path = self._object(digest) / "product.h5"
        if not path.is_file():
            # Another run may be exchanging the folder for an equal one this very moment.
            time.sleep(_READ_RETRY_S)
        try:
            stored = read_product_file(path, map_arrays=True)
        except FileNotFoundError as error:
            raise StoreError(f"the store {self.folder} has no product {digest}") from error
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno:
                raise StoreError(f"cannot read {path}: {error.strerror}") from error
            self._discard(digest)
            raise StoreError(
                f"the stored product {digest[:19]} in {self.folder} was damaged ({error}) and has "
                f"been removed; run again and it is computed anew"
            ) from error
        return cls.from_payload(_as_payload(stored))

    def product_file(self, digest: str) -> Path | None:
        """The HDF5 file of a product, None when it is not there or visibly damaged."""
        path = self._object(digest) / "product.h5"
        return path if _looks_whole(path) else None

    def published_files(self, digest: str) -> tuple[Path, ...]:
        """The files that a product published, sorted by name."""
        folder = self._object(digest) / "files"
        return tuple(sorted(path for path in folder.rglob("*") if path.is_file()))

    # Figures ------------------------------------------------------------------------------------

    def put_blob(self, content: bytes) -> str:
        """Keep bytes, give their SHA-256 in hexadecimal digits.

        Raises:
            StoreError: the disk refuses.
        """
        sha256 = hashlib.sha256(content).hexdigest()
        if self.blob_path(sha256) is None:
            aside = self._new_folder()
            try:
                write_whole(aside / "blob", content)
                place_folder(aside, self.objects / sha256)
            finally:
                remove_tree(aside)
        return sha256

    def blob_path(self, sha256: str) -> Path | None:
        """The file with these bytes, None when it is not there."""
        path = self.objects / sha256 / "blob"
        return path if path.is_file() else None

    # Results ------------------------------------------------------------------------------------

    def result(self, key: str) -> CellResult | None:
        """The result of a key; None when there is none, or some of its objects are missing."""
        path = self.results / f"{key}.json"
        try:
            result = result_from_json(path.read_text(encoding="utf-8"), path.name)
        except (FileNotFoundError, UnicodeDecodeError):
            return None
        except StoreError:
            return None
        except OSError as error:
            raise StoreError(f"cannot read {path}: {error.strerror}") from error
        is_complete = (
            result.key == key
            and result.status == "ok"
            and all(self.product_file(ref.digest) for ref in result.outputs.values())
            and all(self.blob_path(figure.sha256) for figure in result.figures)
        )
        return result if is_complete else None

    def size_bytes(self, result: CellResult) -> int:
        """What a result's products, their published files and its figures take here."""
        return sum(folder_size(self.objects / name) for name in result.objects)

    def touch(self, key: str) -> None:
        """Note that a result was used now; garbage collection keeps what is used."""
        with contextlib.suppress(OSError):
            os.utime(self.results / f"{key}.json")

    def put_result(self, key: str, result: CellResult, step: str) -> None:
        """Keep the result of a cell; its objects must be in the store already.

        Raises:
            StoreError: the disk refuses.
        """
        with writing_to(self.folder):
            folder = self.preimages / result.method
            folder.mkdir(parents=True, exist_ok=True)
            self.results.mkdir(parents=True, exist_ok=True)
        preimage = {"step": step, "preimage": result.key_preimage}
        write_whole(self.results / f"{key}.json", result_to_json(result).encode())
        write_whole(folder / f"{key}.json", json.dumps(preimage).encode())

    def earlier_preimages(self, method: str, *, limit: int = 100) -> tuple[Preimage, ...]:
        """Preimages of earlier results of a method, newest first."""
        folder = self.preimages / method
        dated = []
        with contextlib.suppress(FileNotFoundError):
            dated = [
                (entry.stat().st_mtime_ns, entry.path)
                for entry in os.scandir(folder)
                if entry.name.endswith(".json") and not entry.name.startswith(".")
            ]
        found = (_read_preimage(Path(path)) for _, path in sorted(dated, reverse=True)[:limit])
        return tuple(preimage for preimage in found if preimage is not None)

    # Private ------------------------------------------------------------------------------------

    def _object(self, digest: str) -> Path:
        name = digest.removeprefix("sha256:")
        if len(name) != 64 or not set(name) <= set("0123456789abcdef"):
            raise StoreError(f"{digest!r} is not a digest; expected sha256: and 64 digits 0-9a-f")
        return self.objects / name

    def _new_folder(self) -> Path:
        folder = self._workspace / f"object-{uuid.uuid4().hex}"
        with writing_to(self.folder):
            folder.mkdir(parents=True)
        return folder

    def _finish_object(
        self, aside: Path, product: Product, publisher: Publisher | None, digest: str
    ) -> None:
        if publisher is None:
            return
        files = aside / "files"
        files.mkdir()
        publisher(product, files, digest)
        for path in files.rglob("*"):
            if path.is_file():
                sync_file(path)
            else:
                sync_folder(path)
        sync_folder(files)

    def _place(self, aside: Path, final: Path) -> None:
        if final.exists():
            old = self._workspace / f"replaced-{uuid.uuid4().hex}"
            with contextlib.suppress(FileNotFoundError):
                final.rename(old)
            remove_tree(old)
        place_folder(aside, final)

    def _discard(self, digest: str) -> None:
        aside = self._workspace / f"damaged-{uuid.uuid4().hex}"
        with contextlib.suppress(OSError):
            aside.parent.mkdir(parents=True, exist_ok=True)
            self._object(digest).rename(aside)
            remove_tree(aside)


def list_results(store: Store) -> tuple[StoredResult, ...]:
    """List the results of a store, last used first; unreadable ones are left out."""
    found: list[StoredResult] = []
    for path in store.results.glob("*.json"):
        try:
            result = result_from_json(path.read_text(encoding="utf-8"), path.name)
            used = time_of_file(path.stat().st_mtime)
        except (StoreError, OSError, UnicodeDecodeError):
            continue
        found.append(
            StoredResult(
                key=path.stem,
                method=result.method,
                run_id=result.run_id,
                ended=result.ended,
                last_used=used,
                size_bytes=store.size_bytes(result),
                is_complete=store.result(path.stem) is not None,
            )
        )
    return tuple(sorted(found, key=lambda item: (item.last_used, item.key), reverse=True))


def digest_of(product: Product) -> str:
    """Digest of a product's logical content, `sha256:` + 64 hexadecimal digits."""
    return payload_digest(product.to_payload())


def _describe(folder: Path, type_name: str, publisher_tag: str) -> None:
    size = (folder / "product.h5").stat().st_size
    description = {"type": type_name, "size_bytes": size, "publisher": publisher_tag}
    write_whole(folder / "object.json", json.dumps(description).encode())


def _description(folder: Path) -> dict[str, object]:
    try:
        content = json.loads((folder / "object.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _is_same_object(new: Path, old: Path, publisher_tag: str) -> bool:
    """Whether the old object is whole and needs no newer published files.

    Bytes are compared: the file of an equal product is equal, so a difference means damage.
    """
    if not _looks_whole(old / "product.h5") or _description(old)["publisher"] != publisher_tag:
        return False
    return filecmp.cmp(new / "product.h5", old / "product.h5", shallow=False)


def _looks_whole(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            signature = stream.read(len(_HDF5_SIGNATURE))
            size = os.fstat(stream.fileno()).st_size
    except OSError:
        return False
    return signature == _HDF5_SIGNATURE and _description(path.parent).get("size_bytes") == size


def _as_payload(stored: StoredPayload) -> Payload:
    return Payload(
        type_name=stored.type_name,
        encoding_version=stored.encoding_version,
        metadata=stored.metadata,
        arrays=stored.arrays,
        mapped=stored.mapped,
    )


def _read_preimage(path: Path) -> Preimage | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Preimage(key=path.stem, step=content["step"], text=content["preimage"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
