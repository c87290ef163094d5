"""The store, which contains products by their digest and results by their cache key.

Layout of the store's folder:

    objects/<digest>/product.h5     a product, with `object.json` and its published `files/`
    objects/<digest>/blob           a figure
    results/<key>.json              the result of a cell, with the names of its objects
    digests.json                    cache of the digests of input files; may be deleted
    scratch/<run id>/               work in progress; removed at the end of the run
    lock                            shared by runs, exclusive for garbage collection

Each file has a digest, which is checked when a run or an export uses the file. Damaged files are
removed; a new run then recomputes the missing results. The digest of a figure is its name; results
and descriptions of objects begin with the digest of their remaining text. The digests reveal
damage but not forgery, because anyone who can write to the store can also write digests.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypeVar

from orthoflow_provenance.document import (
    RecordFormatError,
    shared_fields,
)
from pydantic import TypeAdapter

from orthoflow.engine.durability import (
    folder_size,
    is_checked,
    place_folder,
    remove_tree,
    shared_lock,
    sync_tree,
    with_digest,
    write_whole,
    writing_to,
)
from orthoflow.engine.environment import time_of_file
from orthoflow.engine.file_digests import FileDigests, file_sha256
from orthoflow.engine.results import (
    CellResult,
    ProductRef,
    name_problem,
    result_from_json,
    result_to_json,
)
from orthoflow.errors import ArgumentError, DamageError, ProductError, StoreError
from orthoflow.products.product import Payload, Product

# These folders are created on first use of a store. Only all of them together identify a store: a
# git repository also has `objects`, and any folder may have `results`.
_MADE: Final = ("scratch", "objects", "results")
# These names may exist before a store is created: a lock or the digests of input files, and
# `lost+found` in the root folder of a disk.
_OURS: Final = frozenset({*_MADE, "digests.json", "lock", "lost+found"})
PRODUCT: Final = "product.h5"
PUBLISHED: Final = "files"
BLOB: Final = "blob"
DESCRIPTION: Final = "object.json"
# These errors mean that system resources are short, not that a file is damaged.
_SHORTAGES: Final = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


def is_store(folder: Path) -> bool:
    """Whether a folder is a store."""
    return all((folder / name).is_dir() for name in _MADE)


def require_store(folder: Path) -> None:
    """Raise an error if a folder contains other files, because files in a store may be removed.

    A folder is accepted if it is missing, or contains only hidden files and parts of a store.

    Raises:
        ArgumentError: the folder contains other files and is not a store.
        StoreError: the folder cannot be read.
    """
    if is_store(folder) or not folder.is_dir():
        return
    with writing_to(folder):
        names = (path.name for path in folder.iterdir())
        foreign = sorted(name for name in names if name[0] != "." and name not in _OURS)
    if foreign:
        raise ArgumentError(
            f"{folder} is not a store of orthoflow: it contains {foreign[0]}"
            f"{f' and {len(foreign) - 1} more' if foreign[1:] else ''}; give a store, or a folder "
            "that is empty or does not exist yet, with --store"
        )


def make_store(folder: Path) -> None:
    """Create the folders of a store if they are missing.

    Raises:
        ArgumentError: the folder contains other files and is not a store.
        StoreError: the folders cannot be created.
    """
    require_store(folder)
    with writing_to(folder):
        for name in _MADE:
            (folder / name).mkdir(parents=True, exist_ok=True)
        ignore = folder / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n", encoding="utf-8")


if TYPE_CHECKING:
    from orthoflow.catalog.catalog import Publisher

ProductT = TypeVar("ProductT", bound=Product)


@dataclass(frozen=True, kw_only=True)
class StoredProduct:
    """The content of a product's `object.json`.

    Attributes:
        format: name and version of the file format.
        object: name of the object that it describes.
        type: type of the product.
        files: relative path -> size and SHA-256 of each file when it was stored.
    """

    format: Literal["orthoflow/object/1"] = "orthoflow/object/1"
    object: str
    type: str
    files: Mapping[str, tuple[int, str]]


class Store:
    """A folder with products and results that concurrent runs may share.

    The store never contains incomplete data: each file and folder is created under a temporary
    name, synced and renamed.
    """

    def __init__(self, folder: Path, *, workspace: Path | None = None) -> None:
        """Open a store; its folders are created on the first write.

        Args:
            folder: the store's folder.
            workspace: folder for unfinished objects, on the same file system as the store; by
                default a subfolder of the store's scratch folder.
        """
        self.folder = Path(folder).absolute()
        self.scratch = self.folder / "scratch"
        self.results = self.folder / "results"
        self.objects = self.folder / "objects"
        self.lock_file = self.folder / "lock"
        self._workspace = workspace or self.scratch / "loose"
        # This process has checked these files and does not read them again unless they change.
        self._sound: set[tuple[Path, int, int, int, int]] = set()

    def file_digests(self) -> FileDigests:
        """Return the cache of input file digests; call its `save` at the end."""
        return FileDigests(self.folder / "digests.json")

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Prevent garbage collection while the block runs.

        Raises:
            ArgumentError: the folder contains other files and is not a store.
            StoreError: the store's folder cannot be created.
        """
        make_store(self.folder)
        with shared_lock(self.lock_file):
            yield

    def put_product(self, product: Product, publisher: Publisher | None = None) -> ProductRef:
        """Store a product and its published files.

        Args:
            product: the product; nothing is written if the store already contains it with the same
                published files.
            publisher: function that writes the files that the product publishes.

        Raises:
            StoreError: the disk is full or fails.
            ProductError: the product has content that cannot be stored.
        """
        # This module imports h5py, which is not needed for planning.
        from orthoflow_provenance.arrays import write_product_file  # noqa: PLC0415

        aside = self._new_folder()
        try:
            with writing_to(self.folder):
                digest = write_product_file(aside / PRODUCT, product.to_payload())
                final = self._object(digest)
                if publisher is not None:
                    publish_into(aside / PUBLISHED, product, publisher, digest)
                    sync_tree(aside / PUBLISHED)
                files = _describe(aside, final.name, type(product).type_name)
                self._place(aside, final, files)
        except RecordFormatError as error:
            raise ProductError(f"a {product.type_name} cannot be stored: {error}") from error
        finally:
            remove_tree(aside)
        return ProductRef(
            type_name=product.type_name, encoding_version=product.encoding_version, digest=digest
        )

    def get_product(
        self, digest: str, cls: type[ProductT], *, is_checked: bool = False
    ) -> ProductT:
        """Read a product; arrays are read-only, large ones are memory-mapped.

        Args:
            digest: digest of the product.
            cls: class of the product.
            is_checked: whether to skip the check of the bytes; True in steps, whose inputs the
                coordinator has checked.

        Raises:
            DamageError: the product is missing or damaged.
            ProductError: the product has another type.
        """
        from orthoflow_provenance.arrays import read_product_file  # noqa: PLC0415 - as above

        path = self._object(digest) / PRODUCT
        if not path.exists():
            raise DamageError(f"the store {self.folder} has no product {digest}")
        what = f"the stored product {digest[:19]} in {self.folder}"
        damaged = f"{what} was damaged; run again to recompute it"
        if not is_checked and not self.is_sound(digest):
            raise DamageError(damaged)
        try:
            stored = read_product_file(path)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno in _SHORTAGES:
                raise StoreError(f"cannot read {path}: {error.strerror}") from error
            raise DamageError(f"{damaged} ({error})") from error
        return cls.from_payload(Payload(**shared_fields(stored, Payload)))

    def has_product(self, digest: str) -> bool:
        """Return whether the store contains a product; its bytes are not checked."""
        return (self._object(digest) / PRODUCT).exists()

    def product_file(self, digest: str) -> Path | None:
        """Return the path of a product's HDF5 file; None if the product is missing or damaged."""
        return self._object(digest) / PRODUCT if self.is_sound(digest) else None

    def published_files(self, digest: str) -> Mapping[Path, str]:
        """Return the published files of a product, sorted by name, with their expected SHA-256.

        The files are not read here; their digests are checked when they are copied.

        Raises:
            DamageError: the product is missing, or its published files are unknown.
        """
        folder = self._object(digest)
        found = _read_description(folder)
        if found is None:
            raise DamageError(f"the store {self.folder} has no intact product {digest}")
        files = sorted(found.files.items())
        inside = f"{PUBLISHED}/"
        return {folder / name: sha256 for name, (_, sha256) in files if name.startswith(inside)}

    def put_blob(self, content: bytes) -> str:
        """Store bytes and return their SHA-256 as hexadecimal digits.

        Raises:
            StoreError: the disk cannot be written to.
        """
        sha256 = hashlib.sha256(content).hexdigest()
        folder = self.objects / sha256

        if self._damaged_file(folder):
            aside = self._new_folder()
            try:
                write_whole(aside / BLOB, content)
                self._place(aside, folder, {BLOB: (-1, sha256)})
            finally:
                remove_tree(aside)
        return sha256

    def blob(self, sha256: str) -> bytes:
        """Return the bytes of a figure.

        Raises:
            DamageError: the figure is missing or damaged.
        """
        with contextlib.suppress(OSError):
            content = (self._object(sha256) / BLOB).read_bytes()
            if hashlib.sha256(content).hexdigest() == sha256:
                return content
        self.is_sound(sha256)
        raise DamageError(f"the figure {sha256[:12]} in the store {self.folder} is damaged")

    def is_sound(self, name: str) -> bool:
        """Whether a product or figure is undamaged; see `damage`."""
        return not self.damage(name)

    def damage(self, name: str) -> str:
        """Remove an object if it is damaged.

        Args:
            name: name of the object: digest of a product, or SHA-256 of a figure.

        Returns:
            The damaged file, relative to the folder of the object; empty if the object is intact.

        Raises:
            StoreError: the object cannot be removed.
            OSError: memory is short, or too many files are open.
        """
        folder = self._object(name)
        found = self._damaged_file(folder)
        if found:
            self._remove_damaged(folder, lambda: self._damaged_file(folder))
        return found

    def trust(self, result: CellResult) -> None:
        """Mark the objects of a newly computed result as intact."""
        for name in result.objects:
            folder = self.objects / name
            with contextlib.suppress(OSError):
                self._sound.update(_identity(folder / path) for path in _files_of(folder))

    def result(self, key: str) -> CellResult | None:
        """Return the result with a key; None if the result is missing or unusable."""
        return self.look_up(key)[0]

    def look_up(self, key: str) -> tuple[CellResult | None, str]:
        """Return the result of a key.

        Returns:
            The result, which is None if it is missing or unusable; and the damaged or missing
            files of an unusable result, as paths relative to the store's folder.
        """
        path = self.results / f"{key}.json"
        try:
            result = result_from_json(path.read_text(encoding="utf-8"), path.name)
        except FileNotFoundError:
            return None, ""
        except (OSError, UnicodeDecodeError) as error:
            if isinstance(error, OSError) and error.errno in _SHORTAGES:
                raise
            return None, f"results/{path.name}"
        if result.key != key or result.status != "ok":
            return None, f"results/{path.name}"
        damaged = {
            name: self._damaged_file(self.objects / name, by_size=True)
            for name in sorted(result.objects)
        }
        named = [f"objects/{name[:12]}/{file}" for name, file in damaged.items() if file]
        return (None, ", ".join(named)) if named else (result, "")

    def take(self, key: str) -> tuple[CellResult | None, str]:
        """Look up a result for a run, and record for garbage collection when it was used."""
        result, damage = self.look_up(key)
        if result is not None:
            with contextlib.suppress(OSError):
                os.utime(self.results / f"{key}.json")
        return result, damage

    def remove_unusable(self, key: str) -> str:
        """Remove an unusable result, and return its damaged or missing files.

        Raises:
            StoreError: the result cannot be removed.
        """
        _, damage = self.look_up(key)
        if damage:
            self._remove_damaged(self.results / f"{key}.json", lambda: self.look_up(key)[1])
        return damage

    def size_bytes(self, result: CellResult) -> int:
        """Return the total size of a result's products (with published files) and figures."""
        return sum(folder_size(self.objects / name) for name in result.objects)

    def put_result(self, key: str, result: CellResult) -> None:
        """Store the result of a cell; the objects of the result must already be in the store.

        Raises:
            StoreError: the disk cannot be written to.
        """
        with writing_to(self.folder):
            self.results.mkdir(parents=True, exist_ok=True)
        write_whole(self.results / f"{key}.json", result_to_json(result).encode())

    def earlier_results(self, method: str, *, limit: int = 20) -> tuple[CellResult, ...]:
        """Return the results of a method, including incomplete ones, most recently used first."""
        dated = []
        for path in self.results.glob("*.json"):
            with contextlib.suppress(OSError):
                dated.append((path.stat().st_mtime_ns, path))
        found: list[CellResult] = []
        for _, path in sorted(dated, reverse=True):
            with contextlib.suppress(OSError, UnicodeDecodeError):
                text = path.read_text(encoding="utf-8")
                # Most results come from other methods, and parsing all of them would be slow.
                if f'"method":"{method}"' in text:
                    found.append(result_from_json(text, path.name))
            if len(found) == limit:
                break
        return tuple(found)

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

    def _place(self, aside: Path, final: Path, files: Mapping[str, tuple[int, str]]) -> None:
        """Rename a finished object to its final name; replace a damaged or different object."""
        if os.path.lexists(final):
            # Keep an intact object, which another run may be reading.
            if _files_of(final) == files and not self._damaged_file(final):
                return
            with contextlib.suppress(FileNotFoundError):
                self._remove(final)
        place_folder(aside, final)

    def _remove(self, path: Path) -> None:
        """Remove a file or folder atomically, so that no other process sees a part of it."""
        gone = self._workspace / f"removed-{uuid.uuid4().hex}"
        gone.parent.mkdir(parents=True, exist_ok=True)
        path.rename(gone)
        remove_tree(gone)

    def _damaged_file(self, folder: Path, *, by_size: bool = False) -> str:
        files = _files_of(folder)
        if not files:
            return DESCRIPTION
        for name, (size_bytes, sha256) in files.items():
            path = folder / name
            try:
                identity = _identity(path)
                is_sound = identity in self._sound or (
                    stat.S_ISREG(path.lstat().st_mode)
                    and size_bytes in (identity[2], -1)
                    and (by_size or file_sha256(path) == sha256)
                )
            except OSError as error:
                if error.errno in _SHORTAGES and not by_size:
                    raise
                is_sound = False
            if not is_sound:
                return name
            if not by_size:
                self._sound.add(identity)
        return ""

    def _remove_damaged(self, path: Path, damaged: Callable[[], str]) -> None:
        # Another process may have replaced the damaged object in the meantime.
        if not os.path.lexists(path) or not damaged():
            return
        try:
            with writing_to(self.folder):
                self._remove(path)
        except StoreError as error:
            if error.errno != errno.ENOENT:
                raise StoreError(
                    f"{path.parent.name}/{path.name[:12]} in the store {self.folder} is damaged, "
                    f"but cannot be removed: {error}"
                ) from error


def _identity(path: Path) -> tuple[Path, int, int, int, int]:
    found = path.lstat()
    return (path, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


@cache
def _codec() -> TypeAdapter[StoredProduct]:
    return TypeAdapter(StoredProduct)


def _describe(folder: Path, name: str, type_name: str) -> Mapping[str, tuple[int, str]]:
    published = sorted(path for path in (folder / PUBLISHED).rglob("*") if path.is_file())
    files = {
        path.relative_to(folder).as_posix(): (path.stat().st_size, file_sha256(path))
        for path in (folder / PRODUCT, *published)
    }
    found = StoredProduct(object=name, type=type_name, files=files)
    text = _codec().dump_json(found).decode()
    write_whole(folder / DESCRIPTION, with_digest(text).encode())
    return files


def _read_description(folder: Path) -> StoredProduct | None:
    try:
        text = (folder / DESCRIPTION).read_text(encoding="utf-8")
        found = _codec().validate_json(text, strict=True)
    except OSError as error:
        if error.errno in _SHORTAGES:
            raise
        return None
    except ValueError:
        return None
    return found if is_checked(text) and found.object == folder.name else None


def _files_of(folder: Path) -> Mapping[str, tuple[int, str]]:
    """Return path -> size (-1 if unknown) and SHA-256 of the files of an object.

    The result is empty if the description of the object is missing or damaged.
    """
    if folder.is_symlink():
        return {}
    if (folder / BLOB).exists():
        return {BLOB: (-1, folder.name)}
    found = _read_description(folder)
    return found.files if found is not None else {}


def stores_at(folder: str | Path) -> tuple[Store, ...]:
    """Return a tuple with the store in a folder, or an empty tuple if the folder does not exist."""
    return (Store(Path(folder)),) if Path(folder).is_dir() else ()


def publish_into(folder: Path, product: Product, publisher: Publisher, digest: str) -> None:
    """Write the published files of a product to a new folder; only regular files are allowed."""
    folder.mkdir(parents=True)
    publisher(product, folder, digest)
    for path in folder.rglob("*"):
        problem = name_problem(path.name)
        if path.is_symlink() or not (problem or path.is_file() or path.is_dir()):
            problem = "is a link or a device"
        if problem:
            raise ProductError(f"a {product.type_name} publishes {path.name!r}, which {problem}")


def digest_of(product: Product) -> str:
    """Return the digest of a product's content: `sha256:` and 64 hexadecimal digits."""
    from orthoflow_provenance.arrays import payload_digest  # noqa: PLC0415 - as above

    return payload_digest(product.to_payload())


@dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A result in the store.

    Attributes:
        key: cache key.
        method: method id.
        run_id: id of the run that computed the result.
        ended: when its computation ended, ISO 8601, UTC.
        last_used: when a run last used or computed the result, ISO 8601, UTC.
        size_bytes: size of the result's products, including published files; products shared by
            several results are counted in each.
        is_complete: whether all products and figures of the result exist.
    """

    key: str
    method: str
    run_id: str
    ended: str
    last_used: str
    size_bytes: int
    is_complete: bool


def list_results(store: Store) -> tuple[StoredResult, ...]:
    """List the readable results in a store, most recently used first."""
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
