"""The read API and verification, on records made without the engine."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from orthoflow_provenance.arrays import write_product_file
from orthoflow_provenance.document import (
    Metric,
    RecordedCell,
    RecordedFigure,
)
from orthoflow_provenance.record import write_record

from orthoflow.errors import ArgumentError, RecordError
from orthoflow.products import Planes
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, published_files
from orthoflow.records.verify import verify_run
from orthoflow.records.write import publish_products
from tests import samples
from tests.provenance_records import made
from tests.report_runs import cell, given
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
        (store / name).write_text(name)
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
    assert sizes["products/cloud/wall_2.tif"] == len("wall_2.tif")


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
