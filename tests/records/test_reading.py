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
    RecordedFile,
    RecordedInput,
    RecordedProduct,
    RunRecord,
)
from orthoflow_provenance.record import write_record

from orthoflow.engine.journal import cell_file_name
from orthoflow.errors import ArgumentError, RecordError
from orthoflow.products import Planes
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run, published_files
from orthoflow.records.verify import verify_run
from orthoflow.records.write import publish_products
from tests import samples
from tests.report_runs import environment

PNG = b"\x89PNG\r\n\x1a\n picture"
PREIMAGE = '{"method":"plane.given"}'
ENVIRONMENT = environment("sha256:" + "e" * 64)
CLOUD_DIGEST = "sha256:" + "c" * 64


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
    return RecordedCell(
        address="plane@plane=given",
        step="plane",
        method="plane.given",
        status="ok",
        assignment={"plane": "given"},
        distribution="orthoflow-tls",
        distribution_version="0.1.0",
        result_version=1,
        determinism="exact",
        environment=ENVIRONMENT.id,
        params={"tolerance_m": 0.02},
        key=hashlib.sha256(PREIMAGE.encode()).hexdigest(),
        key_preimage=PREIMAGE,
        started="2026-01-02T03:04:05.000Z",
        ended="2026-01-02T03:04:06.500Z",
        wall_s=1.5,
        cpu_s=1.25,
        peak_rss_mib=128.0,
        metrics=(Metric(name="rms_mm", value=2.0, unit="mm"),),
        figures=(RecordedFigure(name="plan", caption="seen", media_type="image/png", data=PNG),),
        warnings=("the side of the viewer is a guess",),
        inputs={
            "cloud": RecordedProduct(
                type_name="cloud", encoding_version=1, digest=CLOUD_DIGEST, source="cloud.cloud"
            )
        },
        outputs={
            "planes": RecordedProduct(
                type_name="planes", encoding_version=1, digest=digest, embedded=True
            )
        },
    )


def cloud_cell() -> RecordedCell:
    return RecordedCell(
        address="cloud",
        step="cloud",
        method="read.scan",
        status="ok",
        distribution="orthoflow-tls",
        distribution_version="0.1.0",
        result_version=1,
        determinism="exact",
        environment=ENVIRONMENT.id,
        started="2026-01-02T03:04:05.000Z",
        ended="2026-01-02T03:04:05.000Z",
        key=hashlib.sha256(b"{}").hexdigest(),
        key_preimage="{}",
        outputs={
            "cloud": RecordedProduct(type_name="cloud", encoding_version=1, digest=CLOUD_DIGEST)
        },
    )


def failed_cell() -> RecordedCell:
    return RecordedCell(
        address="wall",
        step="wall",
        method="raster.grid",
        status="failed",
        error_type="MethodError",
        error_message="no cell has a point",
        wall_s=0.5,
    )


def a_record(digest: str) -> RunRecord:
    return RunRecord(
        run_id="20260102-abc",
        name="room",
        created_by="orthoflow 0.1.0",
        status="failed",
        started="2026-01-02T03:04:05.000Z",
        ended="2026-01-02T03:04:07.000Z",
        seed=1729,
        workflow_source="orthoflow: 1\nname: room\n",
        workflow_resolved='{"name":"room"}',
        inputs=(
            RecordedInput(
                name="scan",
                files=(RecordedFile(name="room.e57", size_bytes=10, sha256="a" * 64),),
            ),
        ),
        environments=(ENVIRONMENT,),
        cells=(cloud_cell(), planes_cell(digest), failed_cell()),
    )


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
    record = a_record(digest)
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


def test_a_product_comes_back_as_it_was(run: Run) -> None:
    planes = run.product("plane@plane=given", "planes")
    assert isinstance(planes, Planes)
    for field in dataclasses.fields(Planes):
        expected, got = getattr(one_plane(), field.name), getattr(planes, field.name)
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(got, expected)
        else:
            assert got == expected


def test_a_figure_comes_back_as_bytes(run: Run) -> None:
    assert run.figure("plane@plane=given", "plan").data == PNG


def test_metrics_hold_what_the_method_and_the_engine_measured_of_good_cells_only(run: Run) -> None:
    rows = [(row.cell, row.metric, row.value, row.unit) for row in run.metric_rows()]
    assert rows[3:] == [
        ("plane@plane=given", "rms_mm", 2.0, "mm"),
        ("plane@plane=given", "wall_s", 1.5, "s"),
        ("plane@plane=given", "cpu_s", 1.25, "s"),
        ("plane@plane=given", "peak_rss_mib", 128.0, "MiB"),
    ]
    assert {row.cell for row in run.metric_rows()} == {"cloud", "plane@plane=given"}


def test_no_published_file_takes_the_place_of_another_or_of_the_metrics(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    names = {"a": ("b_x.csv", "Metrics.CSV"), "b": ("x.csv", "X.csv", "metrics.csv")}
    files = {}
    for port, mine in names.items():
        (tmp_path / port).mkdir()
        paths = [tmp_path / port / name for name in mine]
        for path in paths:
            path.write_text(f"{port} {path.name}", encoding="utf-8")
        files[port] = as_stored(*paths)
    published = publish_products(tmp_path / "run", [cloud_cell()], {"cloud": files}, "r")
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


@pytest.mark.parametrize("changes", [True, False])
def test_what_a_later_step_gives_anew_is_not_published_beside_it(
    tmp_path: Path, *, changes: bool
) -> None:
    def made(address: str, digit: str, **inputs: str) -> RecordedCell:
        """A cell that gives planes, of cells by name -> digit of what they give."""
        planes = RecordedProduct(
            type_name="planes", encoding_version=1, digest=f"sha256:{64 * digit}"
        )
        return dataclasses.replace(
            cloud_cell(),
            address=address,
            step=address,
            inputs={
                f"from_{name}": dataclasses.replace(
                    planes, digest=f"sha256:{64 * given}", source=f"{name}.planes"
                )
                for name, given in inputs.items()
            },
            outputs={"planes": planes},
        )

    cells = [
        made("read", "1", inputs="0"),
        made("plane", "2", read="1"),
        made("sides", "3" if changes else "2", plane="2"),
    ]
    files: dict[str, dict[str, Mapping[Path, str]]] = {}
    for cell in cells:
        (tmp_path / cell.address).mkdir()
        path = tmp_path / cell.address / "planes.json"
        path.write_text(cell.address, encoding="utf-8")
        files[cell.address] = {"planes": as_stored(path)}
    publish_products(tmp_path / "run", cells, files, "r")
    products = tmp_path / "run" / "products"
    # What was read stays, and what nobody changed.
    found = {path.parent.name for path in products.glob("*/planes.json")}
    assert found == ({"read", "sides"} if changes else {"read", "plane", "sides"})


def test_products_are_not_published_through_a_link(tmp_path: Path) -> None:
    for name in ("run", "outside"):
        (tmp_path / name).mkdir()
    (tmp_path / "outside" / "precious.txt").write_text("precious")
    (tmp_path / "run" / "products").symlink_to(tmp_path / "outside")
    publish_products(tmp_path / "run", [cloud_cell()], {}, "r")
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["precious.txt"]
    assert not (tmp_path / "run" / "products").is_symlink()


def test_published_files_come_by_number_and_replace_older_ones(run_folder: Path) -> None:
    store = run_folder / "store"
    store.mkdir()
    for name in ("wall_10.tif", "wall_2.tif", "2.tif", "a.txt"):
        (store / name).write_text(name)
    first = as_stored(*store.iterdir())
    files = {"cloud": {"cloud": first, "more": as_stored(store / "wall_10.tif")}}
    (run_folder / "products" / "old").touch()
    # A cell without a result publishes nothing.
    found = publish_products(
        run_folder, [cloud_cell(), failed_cell()], {**files, "wall": {"x": first}}, "r"
    )
    there = [path.name for path in published_files(run_folder, "cloud")]
    assert there == [
        *("2.tif", "a.txt", "metrics.csv", "more_wall_10.tif", "wall_2.tif", "wall_10.tif"),
    ]
    assert published_files(run_folder, "wall") == ()
    paths = [file.path for file in found]
    assert paths == sorted((*(f"products/cloud/{name}" for name in there), "products/metrics.csv"))
    sizes = {file.path: file.size_bytes for file in found}
    assert sizes["products/cloud/wall_2.tif"] == len("wall_2.tif")


def test_a_long_address_gets_a_folder_name_that_file_systems_take() -> None:
    address = "ortho@" + ",".join(f"step{i}=variant{i}" for i in range(40))
    other = address + "x"
    assert len(cell_file_name(address).encode()) <= 200
    assert cell_file_name(address) != cell_file_name(other)


@pytest.mark.parametrize(("status", "how"), [("failed", "failed"), ("skipped", "was skipped")])
def test_of_a_step_without_a_result_the_reason_is_said(run: Run, status: str, how: str) -> None:
    cell = dataclasses.replace(
        run.cells["cloud"], status=status, outputs={}, error_message="no file"
    )
    other = dataclasses.replace(run, record=dataclasses.replace(run.record, cells=(cell,)))
    with pytest.raises(ArgumentError, match=f"the step cloud gave no 'cloud', it {how}: no file"):
        other.payload("cloud", "cloud")


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda run: run.payload("cloud", "cloud"),
            RecordError,
            "names cloud.cloud only by its digest: it is in the store of the run, from which ",
        ),
        (lambda run: run.payload("roof", "x"), ArgumentError, "has no step 'roof'; it has cloud, "),
        (
            lambda run: run.payload("cloud", "x"),
            ArgumentError,
            "the step cloud has no output 'x'; it has cloud",
        ),
        (
            lambda run: run.figure("cloud", "plan"),
            ArgumentError,
            "the step cloud has no figure 'plan'; it has none at all",
        ),
    ],
    ids=["not embedded", "no such cell", "no such output", "no such figure"],
)
def test_what_a_run_does_not_have_is_said(run: Run, call, error, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(error) as caught:
        call(run)
    assert message in str(caught.value)


def test_a_missing_path_is_an_argument_error(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="does not exist; give a run folder or its "):
        open_run(tmp_path / "none")


def test_a_folder_without_a_record_is_an_unfinished_run(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"holds no run.h5: .* repeat the run with -o "):
        open_run(tmp_path)


def test_a_truncated_record_is_refused_and_does_not_verify(run_folder: Path) -> None:
    path = run_folder / "run.h5"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordError):
        open_run(path)
    assert verify_run(path).findings


def test_an_untouched_record_verifies(run_folder: Path) -> None:
    verification = verify_run(run_folder)
    assert (verification.findings, verification.n_products) == ((), 1)
    assert verification.path == run_folder / "run.h5"
