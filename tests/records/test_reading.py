"""The read API and verification of records and files beside them, made without the engine."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from orthoflow_provenance.arrays import write_product_file
from orthoflow_provenance.document import (
    Metric,
    PublishedFile,
    RecordedCell,
    RecordedFigure,
)
from orthoflow_provenance.record import write_record

from orthoflow.errors import ArgumentError, RecordError
from orthoflow.files.geotiff import local_crs_name
from orthoflow.products import Planes
from orthoflow.products.inspections import Finding
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, published_files, require_unchanged
from orthoflow.records.seals import sealed_page
from orthoflow.records.verify import Verification, verify_run
from orthoflow.records.write import publish_products
from tests import samples
from tests.provenance_records import ProductShelf, made, sample_record
from tests.report_runs import cell, given, inspection_product
from tests.report_runs import record as a_record

PNG = b"\x89PNG\r\n\x1a\n picture"


def one_plane() -> Planes:
    return samples.planes(
        normal=np.array([[0.0, -1.0, 0.0]]),
        offset=np.array([-2.0]),
        corners=np.array([[[0, 2, 3], [0, 2, 0], [4, 2, 0], [4, 2, 3]]], dtype=np.float64),
        n_points=np.array([1200]),
        rms_m=np.array([0.002]),
        names=("wall 0",),
    )


def planes_cell(digest: str) -> RecordedCell:
    return made(
        "plane@plane=given",
        wall_s=1.5,
        cpu_s=1.25,
        compile_s=None,
        metrics=(Metric(name="rms_mm", value=2.0, unit="mm"),),
        figures=(RecordedFigure(name="plan", caption="seen", media_type="image/png", data=PNG),),
        inputs={"cloud": given("cloud.cloud", "c", "cloud")},
        outputs={"planes": dataclasses.replace(given("", "0", "planes"), digest=digest)},
    )


CLOUD = made(
    "cloud", outputs={"cloud": dataclasses.replace(given("", "c", "cloud"), embedded=False)}
)
FAILED = cell("wall", status="failed", error_type="MethodError", error_message="no point")


def as_stored(*paths: Path) -> dict[Path, str]:
    """Files of the store with the digests that they have."""
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A finished run folder with one embedded product and one that is only named."""
    product = tmp_path / "product.h5"
    digest = write_product_file(product, one_plane().to_payload())
    folder = tmp_path / "run"
    folder.mkdir()
    cells = (CLOUD, planes_cell(digest), FAILED)
    record = a_record(cells, run_id="20260102-abc", status="failed")
    write_record(folder / "run.h5", record, lambda asked: product if asked == digest else None)
    published = tmp_path / "planes.json"
    published.write_text('{"planes": []}', encoding="utf-8")
    publish_products(
        folder, record.cells, {"plane@plane=given": {"planes": as_stored(published)}}, "r"
    )
    return folder


@pytest.fixture
def run(run_folder: Path) -> Run:
    return open_run(run_folder)


def test_products_figures_and_metrics_come_back(run: Run) -> None:
    planes = run.product("plane@plane=given", "planes")
    assert isinstance(planes, Planes)
    np.testing.assert_equal(vars(planes), vars(one_plane()))
    assert run.figure("plane@plane=given", "plan").data == PNG
    # Of cells that failed there are none.
    rows = [(row.cell, row.metric, row.value, row.unit) for row in run.metric_rows()]
    assert rows[-4:-1] == [
        ("plane@plane=given", "rms_mm", 2.0, "mm"),
        ("plane@plane=given", "wall_s", 1.5, "s"),
        ("plane@plane=given", "cpu_s", 1.25, "s"),
    ]
    assert {row.cell for row in run.metric_rows()} == {"cloud", "plane@plane=given"}


def test_no_published_file_takes_the_place_of_another_or_of_the_metrics(tmp_path: Path) -> None:
    for name in ("run", "outside"):
        (tmp_path / name).mkdir()
    # Nothing is published through a link either.
    (tmp_path / "outside" / "precious.txt").write_text("precious")
    (tmp_path / "run" / "products").symlink_to(tmp_path / "outside")
    names = {"a": ("b_x.csv", "Metrics.CSV"), "b": ("x.csv", "X.csv", "metrics.csv")}
    files = {}
    for port, mine in names.items():
        (tmp_path / port).mkdir()
        paths = [tmp_path / port / name for name in mine]
        for path in paths:
            path.write_text(f"{port} {path.name}", encoding="utf-8")
        files[port] = as_stored(*paths)
    published = publish_products(tmp_path / "run", [CLOUD], {"cloud": files}, "r")
    cell = tmp_path / "run" / "products" / "cloud"
    assert {path.name: path.read_text(encoding="utf-8")[:20] for path in cell.iterdir()} == {
        "b_x.csv": "a b_x.csv",
        "a_Metrics.CSV": "a Metrics.CSV",
        "x.csv": "b x.csv",
        "b_2_X.csv": "b X.csv",
        "b_metrics.csv": "b metrics.csv",
        "metrics.csv": '"cell","step","metho',
    }
    assert len(published) == 7
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["precious.txt"]


@pytest.mark.parametrize("changes", [True, False])
def test_what_a_later_step_gives_anew_is_not_published_beside_it(
    tmp_path: Path, *, changes: bool
) -> None:
    def giving(address: str, digit: str, **inputs: str) -> RecordedCell:
        """A cell that gives planes, of cells by name -> digit of what they give."""
        taken = {
            f"from_{name}": given(f"{name}.planes", other, "planes")
            for name, other in inputs.items()
        }
        return made(address, inputs=taken, outputs={"planes": given("", digit, "planes")})

    cells = [
        giving("read", "1", inputs="0"),
        giving("plane", "2", read="1"),
        giving("sides", "3" if changes else "2", plane="2"),
    ]
    files: dict[str, dict[str, Mapping[Path, str]]] = {}
    for one in cells:
        (tmp_path / one.address).mkdir()
        path = tmp_path / one.address / "planes.json"
        path.write_text(one.address, encoding="utf-8")
        files[one.address] = {"planes": as_stored(path)}
    publish_products(tmp_path / "run", cells, files, "r")
    products = tmp_path / "run" / "products"
    # What was read stays, and what nobody changed.
    found = {path.parent.name for path in products.glob("*/planes.json")}
    assert found == ({"read", "sides"} if changes else {"read", "plane", "sides"})


def test_published_files_come_by_number_and_replace_older_ones(run_folder: Path) -> None:
    store = run_folder / "store"
    store.mkdir()
    for name in ("wall_10.tif", "wall_2.tif", "2.tif", "a.txt"):
        (store / name).write_text(local_crs_name(name))
    first = as_stored(*store.iterdir())
    files = {"cloud": {"cloud": first, "more": as_stored(store / "wall_10.tif")}}
    (run_folder / "products" / "old").touch()
    # A cell without a result publishes nothing.
    found = publish_products(run_folder, [CLOUD, FAILED], {**files, "wall": {"x": first}}, "r")
    there = [path.name for path in published_files(run_folder, "cloud")]
    assert " ".join(there) == "2.tif a.txt metrics.csv more_wall_10.tif wall_2.tif wall_10.tif"
    assert published_files(run_folder, "wall") == ()
    paths = [file.path for file in found]
    assert paths == sorted((*(f"products/cloud/{name}" for name in there), "products/metrics.csv"))
    sizes = {file.path: file.size_bytes for file in found}
    assert sizes["products/cloud/wall_2.tif"] == len(local_crs_name("wall_2.tif"))
    assert (run_folder / "products/cloud/wall_2.tif").read_text().startswith("run r__")


def test_what_a_run_does_not_have_is_said(run: Run) -> None:
    for status, how in (("failed", "failed"), ("skipped", "was skipped")):
        lost = cell("cloud", status=status, error_message="no file")
        other = dataclasses.replace(run, record=dataclasses.replace(run.record, cells=(lost,)))
        with pytest.raises(
            ArgumentError, match=f"step cloud has no 'cloud', because it {how}: no file"
        ):
            other.payload("cloud", "cloud")
    with pytest.raises(
        RecordError, match=r"contains only the digest of cloud\.cloud; to embed all"
    ):
        run.payload("cloud", "cloud")
    with pytest.raises(ArgumentError, match="has no step 'roof'; it has cloud, "):
        run.payload("roof", "x")
    with pytest.raises(ArgumentError, match="the step cloud has no output 'x'; it has cloud"):
        run.payload("cloud", "x")
    with pytest.raises(ArgumentError, match="step cloud has no figure 'plan'; it has none"):
        run.figure("cloud", "plan")


def test_what_is_no_finished_record_is_refused(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="does not exist; give a run folder or its "):
        open_run(tmp_path / "none")
    with pytest.raises(ArgumentError, match=r"contains no run.h5: .* repeat the run with -o "):
        open_run(tmp_path)
    path = run_folder / "run.h5"
    verification = verify_run(run_folder)
    assert (verification.findings, verification.n_products, verification.path) == ((), 1, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordError):
        open_run(path)
    assert verify_run(path).findings


# What is said of files beside a record, of its page, and of what differs --------------------------


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
