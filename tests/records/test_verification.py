"""What is said of files beside a record, of its signature, and of what differs."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from orthoflow_provenance.document import Metric, PublishedFile
from orthoflow_provenance.record import write_record

from orthoflow.errors import RecordError
from orthoflow.products.inspections import Finding
from orthoflow.records.runs import require_unchanged
from orthoflow.records.seals import sealed_page
from orthoflow.records.verify import Verification, verify_run
from tests.provenance_records import ProductShelf, sample_record
from tests.report_runs import inspection_product

CONTENT = b"a picture"


def published(path: str, content: bytes = CONTENT) -> PublishedFile:
    return PublishedFile(
        path=path, size_bytes=len(content), sha256=hashlib.sha256(content).hexdigest()
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files that are as they were, changed in bytes or in length, gone, or something else."""
    products = tmp_path / "products"
    products.mkdir()
    for name, content in (
        ("same", CONTENT), ("other", b"A picture"), ("longer", CONTENT + b"s"), ("shorter", b"a"),
    ):  # fmt: skip
        (products / name).write_bytes(content)
    (products / "link").symlink_to(products / "same")
    (products / "folder").mkdir()
    os.mkfifo(products / "pipe")
    return tmp_path


def checked(folder: Path, *names: str) -> Verification:
    """Verify a record that names files of a folder; what it names is in `products/`."""
    base = sample_record("sha256:" + "c" * 64, "sha256:" + "d" * 64)
    record = replace(
        base,
        cells=(base.cells[0], base.cells[2]),
        published=tuple(published(f"products/{name}") for name in names),
    )
    write_record(folder / "run.h5", record, lambda _: None)
    return verify_run(folder)


def test_files_beside_a_record_are_counted_and_named(folder: Path) -> None:
    changed, no_file = ("other", "longer", "shorter"), ("link", "folder", "pipe")
    found = checked(folder, "same", *changed, *no_file, "gone", "same/below")
    assert found.n_published == 1
    assert found.findings == (
        *(f"products/{name}: changed since it was published" for name in changed),
        *(
            f"products/{name}: a link, a folder or a device in place of the published file, or it "
            "is unreadable"
            for name in no_file
        ),
    )
    (note,) = found.notes
    assert note.code == "missing"
    assert "products/gone, products/same/below" in note.text
    for name in ("longer", "shorter", "pipe"):
        (folder / "products" / name).unlink()
    (note,) = checked(folder, "same").notes
    assert note.code == "foreign"
    assert "products/link, products/other" in note.text
    # A record that travels alone.
    (note,) = checked(folder, "gone").notes
    assert note.code == "missing"


def test_a_page_is_of_one_record_and_as_it_was_written(tmp_path: Path) -> None:
    own: Any = SimpleNamespace(content_sha256=checked(tmp_path).seal)
    other: Any = SimpleNamespace(content_sha256="b" * 64)
    page = tmp_path / "report.html"

    def is_own() -> bool:
        found = verify_run(tmp_path)
        assert [note.code for note in found.notes] == ["page"] * (1 - found.n_pages)
        return bool(found.n_pages)

    text = sealed_page("<html>1.25 mm</html>", [own, other])
    for shown, is_shown in (([own, other], True), ([other, own], True), ([other], False)):
        page.write_text(sealed_page("<html>1.25 mm</html>", shown))
        assert is_own() is is_shown
    own_digest = own.content_sha256
    for changed in (text.replace("1.25", "0.25"), text + " ", text.replace("b" * 64, own_digest)):
        page.write_text(changed)
        assert not is_own()
    page.write_text("")
    assert not is_own()
    page.unlink()
    page.symlink_to("/dev/zero")
    assert not is_own()


def test_only_what_the_record_vouches_for_is_used(folder: Path) -> None:
    run: Any = SimpleNamespace(
        folder=folder,
        record=SimpleNamespace(
            published=[published(f"products/{name}") for name in ("same", "other", "link", "gone")]
        ),
    )
    products = folder / "products"
    require_unchanged(run, products / "same")
    require_unchanged(run)
    for name, sentence in (
        ("folder", "is not listed in the record of the run, so it cannot be checked"),
        ("other", "other has been changed since the run: its digest in the record is"),
        ("link", "link cannot be read: no file"),
        ("gone", "gone cannot be read: missing"),
    ):
        with pytest.raises(RecordError, match=sentence):
            require_unchanged(run, products / "same", products / name)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"format": "colmap-db"}, "x.h5 is not an orthoflow record: it declares no format"),
        # What a later version writes may be outside this one's format.
        (
            {"format": b"orthoflow-run", "format_version": b"2.0"},
            "x.h5 has format version '2.0', but this program reads version ",
        ),
    ],
)
def test_a_file_of_another_program_or_version_cannot_be_checked(
    tmp_path: Path, stated: dict[str, str | bytes], said: str
) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file.attrs["creator"] = "C"
        for name, value in stated.items():
            file.attrs[name] = np.bytes_(value) if isinstance(value, bytes) else value
    found = verify_run(path)
    assert found.findings[0].startswith(f"/: {said}")
    assert found.wrong == f"{path} cannot be checked"
    assert not found


@pytest.mark.parametrize(
    ("name", "value", "unit", "is_found"),
    [
        ("all_rmse_u_mm", 2.5, "mm", False),
        ("wall_3_rmse_u_mm", 1.25, "mm", False),
        # Of what the inspection does not have, nothing is known.
        ("n_points", 7.0, "1", False),
        ("rmse_u_mm", 1.25, "m", True),
        ("wall_3_rmse_u_mm", 0.25, "mm", True),
    ],
)
def test_metrics_of_an_inspection_are_those_of_its_product(
    tmp_path: Path, name: str, value: float, unit: str, is_found: bool
) -> None:
    findings = (
        Finding(name="rmse_u_mm", value=1.25, unit="mm", wall=0),
        Finding(name="rmse_u_mm", value=2.5, unit="mm"),
    )
    shelf = ProductShelf(tmp_path)
    digest = shelf.put(replace(inspection_product(), findings=findings).to_payload())
    base = sample_record("sha256:" + "c" * 64, digest)
    output = replace(base.cells[1].outputs["walls"], type_name="inspection")
    metrics = (Metric(name=name, value=value, unit=unit),)
    check = replace(base.cells[1], outputs={"inspection": output}, metrics=metrics)
    record = replace(base, cells=(base.cells[0], check, base.cells[2]))
    write_record(tmp_path / "run.h5", record, shelf.find)
    found = verify_run(tmp_path)
    assert bool(found.findings) is is_found, found.findings
    if is_found:
        assert name in found.findings[0]
        assert "contradicts itself" in found.wrong
