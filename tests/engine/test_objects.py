"""Objects of a store: what is sound, what says what they hold, what cannot be one."""

from __future__ import annotations

import errno
import hashlib
import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from orthoflow.engine import objects
from orthoflow.engine.objects import (
    DESCRIPTION,
    PRODUCT,
    PUBLISHED,
    CheckedFiles,
    ObjectFile,
    StoredProduct,
    describe_product,
    files_of,
    read_description,
    require_plain_files,
)
from orthoflow.errors import ProductError


def of(content: bytes) -> ObjectFile:
    return ObjectFile(size_bytes=len(content), sha256=hashlib.sha256(content).hexdigest())


def test_a_file_is_looked_at_once_until_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"content")
    read: list[Path] = []
    digest = objects.file_sha256
    monkeypatch.setattr(objects, "file_sha256", lambda p: read.append(p) or digest(p))
    checked = CheckedFiles()
    assert [checked.is_sound(path, of(b"content")) for _ in range(3)] == [True] * 3
    assert len(read) == 1
    checked.forget(path)
    assert checked.is_sound(path, of(b"content"))
    assert len(read) == 2
    # Of the same size, in a later moment.
    path.write_bytes(b"CONTENT")
    os.utime(path, ns=(1, 1))
    assert checked.is_sound(path, of(b"content")) is False
    assert checked.is_sound(path, of(b"content")) is False
    assert len(read) == 4
    # A size tells enough, and whoever wrote it knows that it is sound.
    assert checked.is_sound(path, of(b"longer content")) is False
    assert len(read) == 4
    checked.trust(path)
    assert checked.is_sound(path, of(b"content"))
    assert checked.is_sound(tmp_path / "gone", of(b"")) is False


def test_want_of_open_files_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"content")
    for number in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
        monkeypatch.setattr(objects, "file_sha256", Mock(side_effect=OSError(number, "why")))
        with pytest.raises(OSError, match="why"):
            CheckedFiles().is_sound(path, of(b"content"))
    monkeypatch.setattr(objects, "file_sha256", Mock(side_effect=OSError(errno.EIO, "why")))
    assert CheckedFiles().is_sound(path, of(b"content")) is False


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An object with a published file in a folder."""
    made = tmp_path / ("0" * 64)
    (made / PUBLISHED / "deep").mkdir(parents=True)
    (made / PRODUCT).write_bytes(b"product")
    (made / PUBLISHED / "deep" / "a.txt").write_bytes(b"text")
    describe_product(made, made.name, "heights", "p1")
    return made


def test_an_object_says_which_files_it_has(folder: Path) -> None:
    files = {PRODUCT: of(b"product"), f"{PUBLISHED}/deep/a.txt": of(b"text")}
    assert read_description(folder) == StoredProduct(
        object=folder.name, type="heights", publisher="p1", files=files
    )
    assert files_of(folder) == files
    # Of another object, changed, or gone, it says nothing.
    other = folder.rename(folder.with_name("1" * 64))
    assert read_description(other) is None
    assert files_of(other) == {}
    folder = other.rename(folder)
    text = (folder / DESCRIPTION).read_text()
    (folder / DESCRIPTION).write_text(text.replace('"p1"', '"p2"'))
    assert read_description(folder) is None
    (folder / DESCRIPTION).unlink()
    assert read_description(folder) is None


def test_want_of_open_files_says_nothing_of_an_object(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (errno.EMFILE, errno.ENOMEM):
        monkeypatch.setattr(Path, "read_text", Mock(side_effect=OSError(number, "why")))
        with pytest.raises(OSError, match="why"):
            read_description(folder)
    monkeypatch.setattr(Path, "read_text", Mock(side_effect=OSError(errno.EIO, "why")))
    assert read_description(folder) is None


def test_what_no_file_can_be_elsewhere_is_not_published(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.txt").touch()
    require_plain_files(tmp_path, "method a.b")
    (tmp_path / "deep" / "b.txt").symlink_to(tmp_path / "deep" / "a.txt")
    with pytest.raises(ProductError, match=r"method a\.b publishes 'b\.txt', which is a link or a"):
        require_plain_files(tmp_path, "method a.b")
    (tmp_path / "deep" / "b.txt").unlink()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ProductError, match=r"publishes 'pipe', which is a link or a device"):
        require_plain_files(tmp_path, "method a.b")
    (tmp_path / "pipe").unlink()
    (tmp_path / "con").touch()
    with pytest.raises(ProductError, match="publishes 'con', which "):
        require_plain_files(tmp_path, "method a.b")
