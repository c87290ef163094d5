"""What is printed of a run, a store and a plan, to the last letter."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
from orthoflow_provenance.record import open_record

from orthoflow.cli.plan import _as_json, _summary
from tests.provenance_records import write_sample
from tests.studios import said


def test_a_run_is_shown_completely(tmp_path: Path) -> None:
    path, record, _ = write_sample(tmp_path)
    wall = "wall@plane=hough2d,orient=pnp#2"
    sha256 = record.inputs[0].files[0].sha256[:12]
    rows = [
        ("step", "method", "status", "time   memory"),
        ("cloud", "read.scan 0.1.0", "ok (cached from earlier-run)", "1.5 s  64 MiB"),
        (wall, "raster.grid 0.1.0", "ok", "1.5 s  64 MiB"),
        ("ortho", "ortho.pointcloud-direct", "failed", ""),
    ]
    assert said("show", path).splitlines() == [
        "court-yard, run 20250102-abc: 3 steps, 2 ok, 1 failed",
        "2025-01-02T03:04:05Z to 2025-01-02T03:05:05Z, orthoflow 0.1.0, seed 7",
        "overrides: wall.gsd_m=0.01",
        f"input scan: hall.laz, 1.0 TiB, sha256 {sha256}",
        "input calibration: not given",
        "",
        *(f"{row[0]:31}  {row[1]:23}  {row[2]:28}  {row[3]}".rstrip() for row in rows),
        "ortho failed: no cell has enough points",
        "",
        f"{'step':31}  metric  value  unit",
        f"{wall}  rms_mm  1.25   mm",
        f"{wall}  cells   5400",
        "",
        "environment: Python 3.11.7, Linux 6.1, A processor, 2 cores, 2 threads",
        "numpy 2.4.0, h5py 3.16.0 and 0 others (--json names them)",
        "",
        f"products: {tmp_path / 'products'}, 0 files",
        "",
        f"`orthoflow verify {path}` checks that nothing changed since it was written",
    ]
    told = json.loads(said("show", path, "--json"))
    assert [cell["address"] for cell in told["cells"]] == ["cloud", wall, "ortho"]
    assert told["cells"][1]["figures"] == [
        {"name": "residuals", "caption": "Résidus", "media_type": "image/png"}
    ]
    assert told["files"] == []
    assert (told["run_id"], told["seed"], told["overrides"]) == (
        *("20250102-abc", 7, ["wall.gsd_m=0.01"]),
    )


def test_a_whole_record_is_verified_and_a_changed_one_named(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        seal = opened.content_sha256
    words = "verified: 1 product (1 more by digest only), seal ok"
    note = "not covered by the record: product-0.h5, product-1.h5"
    assert said("verify", path) == f"note: {note}\nseal: sha256:{seal}\n{words}\n"
    assert json.loads(said("verify", path, "--json")) == {
        "record": str(path),
        "ok": True,
        "products": 1,
        "inputs": 0,
        "published": 0,
        "pages": 0,
        "findings": [],
        "notes": [note],
        "seal": seal,
        "signed_with": "",
    }
    path.write_bytes(path.read_bytes()[:-1])
    assert "is not as it was written, see above\n" in said("verify", path, code=3)
    told = json.loads(said("verify", path, "--json", code=3))
    assert (told["ok"], len(told["findings"])) == (False, 1)


def test_who_shows_a_record_that_was_changed_says_so(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    page = tmp_path / "page.html"
    said("report", path, "-o", page)
    warning = "The record of this run was changed after it was written"
    assert warning not in page.read_text()
    with h5py.File(path, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    doubt = f"{path} is not as it was written: its seal does not hold for /; "
    assert doubt in said("show", path, code=3)
    assert doubt in said("report", path, "-o", page, code=3)
    assert warning in page.read_text()
    assert doubt in said("compare", path, path, code=3)
    (row,) = json.loads(said("runs", tmp_path, "--json"))
    assert (row["status"], row["metrics"]) == ("damaged", {})
    assert row["reason"] == doubt.removesuffix("; ")


def planned(status: str, *, key: object = None) -> Any:
    cell = SimpleNamespace(address=f"a@b={status}", step="a", method="a.b", params={"n": 1})
    return SimpleNamespace(status=status, reason="so", cell=cell, key=key)


def test_a_plan_is_summed_up_by_status() -> None:
    assert _summary([]) == "0 steps: "
    statuses = ("skipped", "cached", "will run", "cached", "unknown yet")
    assert _summary([planned(status) for status in statuses]) == (
        "5 steps: 2 cached, 1 will run, 1 unknown yet, 1 skipped"
    )
    assert _as_json(planned("cached", key=SimpleNamespace(key="abc"))) == {
        "cell": "a@b=cached",
        "step": "a",
        "method": "a.b",
        "status": "cached",
        "reason": "so",
        "key": "abc",
        "params": {"n": 1},
    }
    assert _as_json(planned("will run"))["key"] is None
