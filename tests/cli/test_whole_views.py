"""What is printed of a run, a store and a plan, to the last letter."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
from orthoflow_provenance.record import open_record

from tests.provenance_records import write_sample
from tests.studios import said


def test_a_whole_record_is_verified_and_a_changed_one_named(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    with open_record(path) as opened:
        seal = opened.content_sha256
    verified = said("verify", path)
    assert verified.startswith(f"seal: sha256:{seal}\nverified: seal ok, 1 product (1 more by ")
    assert json.loads(said("verify", path, "--json")) == {
        "record": str(path),
        "ok": True,
        "products": 1,
        "inputs": 0,
        "published": 0,
        "pages": 0,
        "others": 0,
        "not_checked": [],
        "findings": [],
        "notes": [],
        "seal": seal,
        "signed_with": "",
    }
    path.write_bytes(path.read_bytes()[:-1])
    assert "has been changed since it was written (see above)\n" in said("verify", path, code=3)
    verified = json.loads(said("verify", path, "--json", code=3))
    assert (verified["ok"], len(verified["findings"])) == (False, 1)


def test_who_shows_a_record_that_was_changed_says_so(tmp_path: Path) -> None:
    path, _, _ = write_sample(tmp_path)
    page = tmp_path / "page.html"
    said("report", path, "-o", page)
    warning = "The record of this run has been changed since it was written"
    assert warning not in page.read_text()
    with h5py.File(path, "r+") as file:
        file.attrs["seed"] = type(file.attrs["seed"])(b"8")
    doubt = f"{path} has been changed since it was written: its seal does not match /; "
    assert doubt in said("show", path, code=3)
    assert doubt in said("report", path, "-o", page, code=3)
    assert warning in page.read_text()
    assert doubt in said("compare", path, path, code=3)
    (row,) = json.loads(said("runs", tmp_path, "--json"))
    assert (row["status"], row["metrics"]) == ("damaged", {})
    assert row["reason"] == doubt.removesuffix("; ")
