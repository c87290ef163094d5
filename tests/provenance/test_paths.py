"""Names from strangers become files in their folder, or nothing at all."""

from __future__ import annotations

import os
import socket
import unicodedata
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from orthoflow_provenance.document import UnsafeFileError
from orthoflow_provenance.paths import (
    colliding,
    create_below,
    files_below,
    name_problem,
    open_below,
    path_below,
    path_problem,
)

REFUSED = {
    "is empty": ("",),
    "is . or ..": (".", ".."),
    "contains / or a backslash": ("/etc/passwd", "..\\x"),
    "contains a control character": ("a\nb", "a\x85b", "a\u2028b", "a\ud800b"),
    "is longer than 255 bytes": ("ä" * 128,),
    "ends with a dot or a space": ("photo.",),
    "is a reserved device name": ("con", "Aux .tar.gz", "com1", "LPT³", "CONIN$"),
    "begins with a drive letter": ("C:x",),
}
TAKEN = ("hall.e57", "ortho@plane=ransac,orient=pnp#2", ".hidden", "Saal 12:30.jpg", "ä" * 127)
TAKEN += ("console", "com10", "null", "a..b", "..a", "שלום.jpg", "a\u200cb", "👩‍🚒.png")
# Letters that paths are made of, and any others.
NAMES = st.text(st.sampled_from("./\\ab:\0\n ~-") | st.characters(), max_size=12)


@pytest.mark.parametrize("problem", REFUSED)
def test_names_that_lead_elsewhere_or_are_no_names_everywhere_are_refused(problem: str) -> None:
    for name in REFUSED[problem]:
        assert name_problem(name) == problem
        with pytest.raises(UnsafeFileError, match="so it cannot be a file name here"):
            path_below(Path("folder"), name)


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        ("", "is empty"),
        ("/etc/passwd", "is absolute"),
        ("products//a.tif", "has a part that is empty"),
        ("products/../../a.tif", "has a part that is . or .."),
        ("products/a.tif/", "has a part that is empty"),
        # Letters of two bytes: seventeen parts of 240 bytes, and the slashes between them.
        ("/".join(["ö" * 120] * 16 + ["a" * 240]), "is longer than 4095 bytes"),
        ("/".join(["ö" * 120] * 16 + ["a" * 239]), ""),
        ("products/" + "ö" * 128, "has a part that is longer than 255 bytes"),
        *((name, "") for name in TAKEN),
    ],
)
def test_paths_that_lead_elsewhere_or_are_too_long_are_refused(path: str, problem: str) -> None:
    assert path_problem(path) == problem


@settings(max_examples=60)
@given(st.lists(NAMES, max_size=4).map("/".join), st.binary(max_size=20))
@example("..", b"")
@example("a/../../b", b"")
@example("//a", b"")
def test_what_is_written_under_any_name_stays_below_its_folder_or_nothing_is_written(
    tmp_path_factory: pytest.TempPathFactory, path: str, content: bytes
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    folder = outside / "inside"
    folder.mkdir()
    try:
        with create_below(folder, path) as stream:
            stream.write(content)
    except UnsafeFileError:
        assert path_problem(path)
        assert list(outside.rglob("*")) == [folder]
        return
    made = path_below(folder, path)
    assert os.path.normpath(made) == str(made) == f"{folder}/{path}"
    assert not any(unicodedata.category(letter) in {"Cc", "Cs"} for letter in path)
    with open_below(folder, path) as stream:
        assert stream.read() == content
    assert [item for item in outside.rglob("*") if item.is_file()] == [made]


@pytest.mark.parametrize(
    ("one", "other"),
    [("a.png", "A.png"), ("ä.png", "a\u0308.png"), ("straße", "STRASSE"), ("x", "x")],
)
def test_names_that_some_systems_take_for_one_collide(one: str, other: str) -> None:
    assert colliding(["b", one, "c", other]) == other
    assert colliding(["b", one, "c"]) == ""


def test_only_files_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (folder / "folder").mkdir()
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "link").symlink_to(secret)
    (folder / "dangling").symlink_to(tmp_path / "nothing")
    (folder / "way").symlink_to(tmp_path)
    (folder / "own").write_text("own")
    (folder / "to-own").symlink_to("own")
    with socket.socket(socket.AF_UNIX) as opened:
        # Addresses of sockets are short.
        monkeypatch.chdir(folder)
        opened.bind("socket")
        for name in ("folder", "pipe", "zero", "link", "dangling", "to-own", "socket"):
            with pytest.raises(UnsafeFileError, match=f"'{name}' must be a file, but is a"):
                open_below(folder, name)
    with pytest.raises(UnsafeFileError, match="'way' is a link, and links are not followed"):
        open_below(folder, "way/secret")
    with pytest.raises(FileNotFoundError):
        open_below(folder, "nothing")
    with open_below(folder, "own") as stream:
        assert stream.read() == b"own"
    assert files_below(tmp_path, "run") == ("own",)
    assert files_below(folder, "way") == ()
    assert files_below(folder, "nothing") == ()


def test_a_file_exchanged_after_the_look_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "secret").write_text("secret")
    path = tmp_path / "run" / "a.tif"
    path.parent.mkdir()
    path.write_text("pixels")
    look = os.stat
    exchanged: list[Path] = []

    def stat(name: Any, **options: Any) -> os.stat_result:
        found = look(name, **options)
        if name == path and not exchanged:
            exchanged.append(path)
            path.unlink()
            path.symlink_to(tmp_path / "secret")
        return found

    with monkeypatch.context() as patch:
        patch.setattr(os, "stat", stat)
        with pytest.raises(OSError, match="symbolic links"):
            open_below(path.parent, path.name)
    assert path.is_symlink()


def test_nothing_is_written_through_a_link_and_what_is_not_completed_is_not_kept(
    tmp_path: Path,
) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "run"
    outside.mkdir()
    folder.mkdir()
    other = outside / "other.txt"
    other.write_text("as it was")
    (folder / "way").symlink_to(outside)
    (folder / "other.txt").symlink_to(other)
    with (
        pytest.raises(UnsafeFileError, match="'way' is a link"),
        create_below(folder, "way/new.txt"),
    ):
        pass
    # The link itself is replaced.
    with create_below(folder, "other.txt") as stream:
        stream.write(b"new")
    assert (other.read_text(), (folder / "other.txt").read_text()) == ("as it was", "new")
    assert list(outside.iterdir()) == [other]
    with pytest.raises(TypeError), create_below(folder, "other.txt") as stream:
        stream.writelines([b"newer", None])  # type: ignore[list-item]
    assert {path.name for path in folder.iterdir()} == {"way", "other.txt"}
    assert (folder / "other.txt").read_text() == "new"
