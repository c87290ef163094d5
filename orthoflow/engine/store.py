"""The store: products by digest, results by key; the engine's only access to the record format.

Layout below the store's folder:

    objects/<digest>/product.h5     a product, `object.json` beside it, `files/` what it publishes
    objects/<digest>/blob           a figure
    results/<key>.json              what a cell gave, naming objects
    preimages/<method>/<key>.json   small copies of the keys' preimages, for explanations
    failures/<key>                  how cells failed last time; disposable
    digests.json                    memory of input files' digests; disposable
    scratch/<run id>/               work in progress; removed with its run
    lock                            shared by runs, exclusive for garbage collection

Everything has the digest of its bytes and is checked when a run, or an export, uses it. What is
damaged is removed and computed again. Figures name themselves, and keys their preimages; results
and descriptions of objects begin with the digest of the rest. They show what is damaged, not
who did it: whoever can write to the store can write digests, too.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import stat
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Final, Literal, Protocol, TypeVar

from orthoflow_provenance.document import (
    RecordFormatError,
    canonical_json,
    sha256_text,
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
from orthoflow.sdk.lines import one_line
from orthoflow.untrusted_text import open_file, parse_json

# Created together when a store is first used. The last one identifies a store: a git repository has
# `objects`, and any folder may have `results`.
_MADE: Final = ("scratch", "results", "objects", "preimages")
# Other files that may be created first, such as a lock. A separate disk has `lost+found`, and
# systems create hidden files everywhere.
_OURS: Final = frozenset({*_MADE, "failures", "digests.json", "lock", "lost+found"})
PRODUCT: Final = "product.h5"
PUBLISHED: Final = "files"
BLOB: Final = "blob"
DESCRIPTION: Final = "object.json"
# The missing part if nothing of an object exists.
WHOLE: Final = "whole object"
_PARTS: Final = {PRODUCT: "product file", BLOB: "figure", DESCRIPTION: "description"}
# The machine lacks a resource: that does not mean damage.
_SHORTAGES: Final = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


def is_store(folder: Path) -> bool:
    """Whether a folder is the store of a run."""
    return (folder / _MADE[-1]).is_dir()


def require_store(folder: Path) -> None:
    """Refuse a folder with other content, because a store is written to and cleaned up.

    A missing one, or one with only hidden files and parts of a store, may become one.

    Raises:
        ArgumentError: there are other files, and no store.
        StoreError: the folder cannot be read.
    """
    if is_store(folder) or not folder.is_dir():
        return
    with writing_to(folder):
        names = (path.name for path in folder.iterdir())
        foreign = sorted(name for name in names if name[0] != "." and name not in _OURS)
    if foreign:
        raise ArgumentError(
            f"{folder} is not a store of orthoflow: it holds {foreign[0]}"
            f"{f' and {len(foreign) - 1} more' if foreign[1:] else ''}; name a store, or a folder "
            "that is empty or not there yet, with --store"
        )


def make_store(folder: Path) -> None:
    """Create the folders of a store, if they are missing.

    Raises:
        ArgumentError: the folder has other content.
        StoreError: they cannot be created.
    """
    require_store(folder)
    with writing_to(folder):
        for name in _MADE:
            (folder / name).mkdir(parents=True, exist_ok=True)
        ignore = folder / ".gitignore"
        if not ignore.exists():
            ignore.write_text("*\n", encoding="utf-8")


__all__ = [
    "Preimage",
    "Publisher",
    "Store",
    "canonical_json",
    "digest_of",
]

_READ_RETRY_S: Final = 0.05
# A reason is in one column of a table; the record of the run has the whole sentence.
_LONGEST_FAILURE: Final = 400

ProductT = TypeVar("ProductT", bound=Product)


class Publisher(Protocol):
    """Writes the files of a product for other programs."""

    def __call__(self, product: Product, folder: Path, digest: str, /) -> object:
        """Write the files into an existing empty folder."""


@dataclass(frozen=True, kw_only=True)
class StoredProduct:
    """The content of a product's `object.json`.

    Attributes:
        format: name and version of this file.
        object: name of its object: a description does not describe another.
        type: of the product.
        publisher: tag of the code that wrote the published files; empty if none did.
        files: size and SHA-256 of each file as it was stored, by path in the folder.
    """

    format: Literal["orthoflow/object/1"] = "orthoflow/object/1"
    object: str
    type: str
    publisher: str
    files: Mapping[str, tuple[int, str]]


@dataclass(frozen=True, kw_only=True)
class Preimage:
    """Key preimage of an earlier result, with the name of its step."""

    key: str
    step: str
    text: str


class Store:
    """A folder of products and results that runs share, also at the same time.

    Incomplete data are never accepted: every file and folder is created under a temporary name,
    synced and renamed.
    """

    def __init__(self, folder: Path, *, workspace: Path | None = None) -> None:
        """Name a store; nothing is created before something is written.

        Args:
            folder: the store's folder.
            workspace: folder of unfinished objects, on the same file system; by default below the
                store's scratch folder.
        """
        self.folder = Path(folder).absolute()
        self.scratch = self.folder / "scratch"
        self.results = self.folder / "results"
        self.objects = self.folder / "objects"
        self.preimages = self.folder / "preimages"
        self.failures = self.folder / "failures"
        self.lock_file = self.folder / "lock"
        self._workspace = workspace or self.scratch / "loose"
        # Unchanged files need not be read twice; the first read checks them.
        self._sound: set[tuple[Path, int, int, int, int]] = set()
        self._found_damaged: dict[str, str] = {}

    def file_digests(self) -> FileDigests:
        """Return the cache of input files' digests; call its `save` when done."""
        return FileDigests(self.folder / "digests.json")

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Prevent garbage collection.

        Raises:
            ArgumentError: the folder has other content.
            StoreError: the store's folder cannot be created.
        """
        make_store(self.folder)
        with shared_lock(self.lock_file):
            yield

    # Products -----------------------------------------------------------------------------------

    def put_product(
        self, product: Product, publisher: Publisher | None = None, *, publisher_tag: str = ""
    ) -> ProductRef:
        """Store a product and its published files.

        Args:
            product: the product; an equal one that is there already stays.
            publisher: writes its published files.
            publisher_tag: version of the publisher; files of another version are written again.

        Raises:
            StoreError: full disk, or another failure of the disk.
            ProductError: the product has content that cannot be stored.
        """
        # Loads h5py, which a plan does not need.
        from orthoflow_provenance.arrays import write_product_file  # noqa: PLC0415

        aside = self._new_folder()
        try:
            with writing_to(self.folder):
                digest = write_product_file(aside / PRODUCT, product.to_payload())
                final = self._object(digest)
                tag = publisher_tag if publisher else ""
                is_there = partial(self._is_there, final, tag)
                if not is_there():
                    if publisher is not None:
                        publish_into(aside / PUBLISHED, product, publisher, digest)
                        sync_tree(aside / PUBLISHED)
                    _describe(aside, final.name, type(product).type_name, tag)
                    self._place(aside, final, is_there)
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
        """Read a product; arrays are read-only, large ones memory-mapped.

        Args:
            digest: of the product.
            cls: its type.
            is_checked: its bytes have been checked already, as the coordinator does for steps.

        Raises:
            DamageError: it is missing or damaged.
            ProductError: it is of another type.
        """
        from orthoflow_provenance.arrays import read_product_file  # noqa: PLC0415 - as above

        path = self._object(digest) / PRODUCT
        if not path.is_file():
            # Another run may be replacing the folder by an equal one at this moment.
            time.sleep(_READ_RETRY_S)
        if not path.exists():
            raise DamageError(f"the store {self.folder} has no product {digest}")
        what = f"the stored product {digest[:19]} in {self.folder}"
        damaged = f"{what} was damaged; run again to compute it again"
        if not is_checked and not self.is_sound(digest):
            raise DamageError(damaged)
        try:
            stored = read_product_file(path, map_arrays=True)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno in _SHORTAGES:
                raise StoreError(f"cannot read {path}: {error.strerror}") from error
            raise DamageError(f"{damaged} ({error})") from error
        return cls.from_payload(Payload(**shared_fields(stored, Payload)))

    def product_file(self, digest: str) -> Path | None:
        """Return the HDF5 file of a product, None if it is missing or damaged."""
        return self._object(digest) / PRODUCT if self.is_sound(digest) else None

    def published_files(self, digest: str) -> Mapping[Path, str]:
        """Published files of a product, sorted by name, and the required SHA-256 of each.

        They are not read here: copying them computes the digests.

        Raises:
            DamageError: the product is missing, or its published files are unknown.
        """
        folder = self._object(digest)
        found = _read_description(folder)
        if found is None:
            raise DamageError(f"the store {self.folder} has no sound product {digest}")
        files = sorted(found.files.items())
        return {folder / name: sha256 for name, (_, sha256) in files if _is_published(name)}

    # Figures ------------------------------------------------------------------------------------

    def put_blob(self, content: bytes) -> str:
        """Store bytes, return their SHA-256 in hexadecimal digits.

        Raises:
            StoreError: the disk cannot be written.
        """
        sha256 = hashlib.sha256(content).hexdigest()
        folder = self.objects / sha256

        def is_there() -> bool:
            return not self._damaged_part(folder, again=True)

        if not is_there():
            aside = self._new_folder()
            try:
                write_whole(aside / BLOB, content)
                self._place(aside, folder, is_there)
            finally:
                remove_tree(aside)
        return sha256

    def blob(self, sha256: str) -> bytes:
        """Return the bytes of a figure.

        Raises:
            DamageError: they are missing or damaged.
        """
        with contextlib.suppress(OSError):
            content = (self._object(sha256) / BLOB).read_bytes()
            if hashlib.sha256(content).hexdigest() == sha256:
                return content
        self.is_sound(sha256)
        raise DamageError(f"the figure {sha256[:12]} in the store {self.folder} is damaged")

    # Damage -------------------------------------------------------------------------------------

    def is_sound(self, name: str, *, again: bool = False) -> bool:
        """Whether a product or a figure has its original bytes; see `damage`."""
        return not self.damage(name, again=again)

    def damage(self, name: str, *, with_published: bool = False, again: bool = False) -> str:
        """Return the damaged part of an object, and remove the object; empty if it is intact.

        Args:
            name: of the object: digest of a product, or SHA-256 of a figure.
            with_published: also check the published files.
            again: also check files that this process has found intact and that are unchanged since.

        Raises:
            StoreError: it cannot be removed.
            OSError: the machine lacks memory or open files.
        """
        folder = self._object(name)
        damaged_part = partial(
            self._damaged_part, folder, with_published=with_published, again=again
        )
        part = damaged_part()
        if part and not self._remove_damaged(folder, damaged_part):
            # It is gone, or another run has replaced it, or a read failed only once.
            part = damaged_part()
        if part and part != WHOLE:
            self._found_damaged[folder.name] = part
        return part

    def damaged_objects(self, names: Iterable[str]) -> tuple[str, ...]:
        """Check every byte of objects, remove damaged ones and name them."""
        wanted = dict.fromkeys(names)
        return tuple(name for name in wanted if self.damage(name, with_published=True, again=True))

    def trust(self, result: CellResult) -> None:
        """Mark the objects of a result that was just computed as intact."""
        for name in result.objects:
            folder = self.objects / name
            with contextlib.suppress(OSError):
                self._sound.update(_identity(folder / path) for path in _files_of(folder))

    # Results ------------------------------------------------------------------------------------

    def result(self, key: str) -> CellResult | None:
        """Result of a key; None without one, or if objects of it are visibly incomplete."""
        result = self._read_result(key)
        return None if result is None or self._missing_parts(result) else result

    def take(self, key: str) -> tuple[CellResult | None, str]:
        """Use the result of a key in a run; visibly damaged parts are removed.

        Returns:
            The result, None if there is none or an incomplete one; and its damaged parts.

        Raises:
            StoreError: the store cannot be read.
        """
        result = self._read_result(key)
        if result is None:
            path = self.results / f"{key}.json"
            is_damaged = self._remove_damaged(path, lambda: self._read_result(key) is None)
            return None, "result file" if is_damaged else ""
        if missing := self._missing_parts(result):
            for name in missing:
                folder = self.objects / name
                self._remove_damaged(folder, partial(self._missing_part, folder))
            return None, ", ".join(dict.fromkeys(missing.values()))
        with contextlib.suppress(OSError):
            os.utime(self.results / f"{key}.json")
        return result, ""

    def damage_of_result(self, key: str) -> str:
        """Return why a result is unusable, and remove it; empty if it is complete.

        Raises:
            StoreError: it cannot be removed.
        """
        result = self._read_result(key)
        reason = "result file" if result is None else ""
        for name, part in self._missing_parts(result).items() if result is not None else ():
            reason = f"needs objects/{name[:12]}, which is damaged ({part})"
        if reason:
            self._remove_damaged(self.results / f"{key}.json", lambda: self.result(key) is None)
        return reason

    def size_bytes(self, result: CellResult) -> int:
        """Return the size of a result's products, their published files and its figures."""
        return sum(folder_size(self.objects / name) for name in result.objects)

    def put_result(self, key: str, result: CellResult, step: str) -> None:
        """Store the result of a cell; its objects must be in the store already.

        Raises:
            StoreError: the disk cannot be written.
        """
        with writing_to(self.folder):
            folder = self.preimages / result.method
            folder.mkdir(parents=True, exist_ok=True)
            self.results.mkdir(parents=True, exist_ok=True)
        preimage = {"step": step, "preimage": result.key_preimage}
        write_whole(self.results / f"{key}.json", result_to_json(result).encode())
        write_whole(folder / f"{key}.json", json.dumps(preimage).encode())

    def earlier_preimages(self, method: str, *, limit: int = 100) -> tuple[Preimage, ...]:
        """Yield preimages of earlier results of a method, newest first."""
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

    # Failures -----------------------------------------------------------------------------------

    def remember_failure(self, key: str, sentence: str) -> None:
        """Keep the sentence with which a cell failed, if the disk lets us."""
        with contextlib.suppress(OSError, StoreError):
            self.failures.mkdir(parents=True, exist_ok=True)
            write_whole(self.failures / key, one_line(sentence, _LONGEST_FAILURE).encode())

    def forget_failure(self, key: str) -> None:
        """Remove the sentence, because the cell has a result now."""
        with contextlib.suppress(OSError):
            (self.failures / key).unlink()

    def last_failure(self, key: str) -> str:
        """Return how a cell failed; empty if it did not, or if the sentence is no longer kept."""
        with contextlib.suppress(OSError), open_file(self.failures / key) as stream:
            # Twice, for letters that no terminal shows are longer when they are written out.
            text = stream.read(4 * _LONGEST_FAILURE).decode(errors="replace")
            return one_line(text, 2 * _LONGEST_FAILURE)
        return ""

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

    def _place(self, aside: Path, final: Path, is_there: Callable[[], bool]) -> None:
        """Give a finished object its name, in the place of one that cannot be used."""
        if os.path.lexists(final):
            # Another run has stored an equal one meanwhile, and may be reading it.
            if is_there():
                return
            with contextlib.suppress(FileNotFoundError):
                self._remove(final)
        place_folder(aside, final)

    def _remove(self, path: Path) -> None:
        """Remove a file or folder at once: nobody finds a part of it."""
        gone = self._workspace / f"removed-{uuid.uuid4().hex}"
        gone.parent.mkdir(parents=True, exist_ok=True)
        path.rename(gone)
        remove_tree(gone)

    def _read_result(self, key: str) -> CellResult | None:
        path = self.results / f"{key}.json"
        try:
            result = result_from_json(path.read_text(encoding="utf-8"), path.name)
        except (OSError, UnicodeDecodeError) as error:
            if isinstance(error, OSError) and error.errno in _SHORTAGES:
                raise
            return None
        return result if result.key == key and result.status == "ok" else None

    def _is_there(self, folder: Path, publisher_tag: str) -> bool:
        """Whether an equal object is stored, intact, and its published files are current."""
        found = _read_description(folder)
        is_current = found is not None and found.publisher == publisher_tag
        return is_current and not self._damaged_part(folder, with_published=True, again=True)

    def _missing_parts(self, result: CellResult) -> dict[str, str]:
        """Return the damaged part of each object of a result that is visibly incomplete."""
        parts = {name: self._missing_part(self.objects / name) for name in sorted(result.objects)}
        return {name: self._found_damaged.get(name, part) for name, part in parts.items() if part}

    def _missing_part(self, folder: Path) -> str:
        """Part of an object that is missing or of another size; empty if none."""
        return self._damaged_part(folder, with_published=True, by_size=True)

    def _damaged_part(
        self,
        folder: Path,
        *,
        with_published: bool = False,
        again: bool = False,
        by_size: bool = False,
    ) -> str:
        files = _files_of(folder)
        if not files:
            return _PARTS[DESCRIPTION] if folder.is_dir() else WHOLE
        for name, (size_bytes, sha256) in files.items():
            path = folder / name
            if _is_published(name) and not with_published:
                continue
            try:
                identity = _identity(path)
                if again:
                    self._sound.discard(identity)
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
                return _part_name(name)
            if not by_size:
                self._sound.add(identity)
        return ""

    def _remove_damaged(self, path: Path, is_damaged: Callable[[], object]) -> bool:
        """Remove a file or folder, if it exists and is still damaged.

        Raises:
            StoreError: it cannot be removed.
        """
        # Another run may have been faster, and may have stored an intact one.
        if not os.path.lexists(path) or not is_damaged():
            return False
        try:
            with writing_to(self.folder):
                self._remove(path)
        except StoreError as error:
            if error.errno == errno.ENOENT:
                return False
            raise StoreError(
                f"{path.parent.name}/{path.name[:12]} in the store {self.folder} is damaged, but "
                f"cannot be removed: {error}"
            ) from error
        return True


def _identity(path: Path) -> tuple[Path, int, int, int, int]:
    found = path.lstat()
    return (path, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


def _is_published(name: str) -> bool:
    return name.startswith(f"{PUBLISHED}/")


def _part_name(path: str) -> str:
    """Return the readable name of a file of an object."""
    return _PARTS.get(path) or f"published file {path.removeprefix(f'{PUBLISHED}/')}"


@cache
def _codec() -> TypeAdapter[StoredProduct]:
    return TypeAdapter(StoredProduct)


def _describe(folder: Path, name: str, type_name: str, publisher: str) -> None:
    """Write `object.json` for the files that lie in a folder."""
    published = sorted(path for path in (folder / PUBLISHED).rglob("*") if path.is_file())
    files = {
        path.relative_to(folder).as_posix(): (path.stat().st_size, file_sha256(path))
        for path in (folder / PRODUCT, *published)
    }
    found = StoredProduct(object=name, type=type_name, publisher=publisher, files=files)
    text = _codec().dump_json(found).decode()
    write_whole(folder / DESCRIPTION, with_digest(text).encode())


def _read_description(folder: Path) -> StoredProduct | None:
    """Read `object.json`; None if it is damaged, belongs to another object, or is missing."""
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
    """Return size, -1 if unknown, and SHA-256 of an object's files; empty if they are unknown."""
    if folder.is_symlink():
        return {}
    if (folder / BLOB).exists():
        return {BLOB: (-1, folder.name)}
    found = _read_description(folder)
    return found.files if found is not None else {}


def stores_at(folder: str | Path) -> tuple[Store, ...]:
    """Return the store of a folder, if there is one; it is not created."""
    return (Store(Path(folder)),) if Path(folder).is_dir() else ()


def publish_into(folder: Path, product: Product, publisher: Publisher, digest: str) -> None:
    """Let a product publish its files in a new folder: plain files only."""
    folder.mkdir(parents=True)
    publisher(product, folder, digest)
    for path in folder.rglob("*"):
        problem = name_problem(path.name)
        if path.is_symlink() or not (problem or path.is_file() or path.is_dir()):
            problem = "is a link or a device"
        if problem:
            raise ProductError(f"a {product.type_name} publishes {path.name!r}, which {problem}")


def digest_of(product: Product) -> str:
    """Return the digest of a product's logical content, `sha256:` + 64 hexadecimal digits."""
    from orthoflow_provenance.arrays import payload_digest  # noqa: PLC0415 - as above

    return payload_digest(product.to_payload())


def _read_preimage(path: Path) -> Preimage | None:
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            return None
        found = Preimage(key=path.stem, step=content["step"], text=content["preimage"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if sha256_text(found.text) == found.key else None


@dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A result in the store.

    Attributes:
        key: cache key.
        method: method id.
        run_id: the run that computed it.
        ended: ISO 8601 UTC.
        last_used: ISO 8601 UTC, when a run last used or created it.
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


def list_results(store: Store) -> tuple[StoredResult, ...]:
    """List the results of a store, last used first; unreadable ones are omitted."""
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
