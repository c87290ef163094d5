"""Records of formats 1.0 and 1.1, written once: every later version verifies and replays them.

Where one of these tests fails, old records can no longer be read or made again: raise the
`result_version` of the method or the `encoding_version` of the product that changed, keep the old
record with a test of what is said about it, and make new ones with provenance/reference/make.py.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from orthoflow.records.open import open_run
from tests.studios import Studio, open_studio

REFERENCE = Path(__file__).resolve().parents[2] / "provenance" / "reference"
WORKFLOWS = {"studio": "studio", "comparison": "comparison", "embedded": "studio"}


@pytest.fixture
def studio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Studio:
    return open_studio(tmp_path, monkeypatch)


@pytest.mark.parametrize("name", WORKFLOWS)
def test_reference_records_verify_and_replay_with_the_same_bits(studio: Studio, name: str) -> None:
    path = REFERENCE / f"{name}.h5"
    if name == "embedded":
        # Where nothing else is: its input lies in it.
        path = shutil.copyfile(path, Path("embedded.h5"))
    assert path.stat().st_size < 200_000
    assert studio("verify", path).exit_code == 0
    recorded = open_run(path)
    source = (REFERENCE / f"{WORKFLOWS[name]}.yaml").read_text()
    assert recorded.record.workflow_source == source
    said = studio.json("replay", path, "-o", "again")
    n_products = sum(len(cell.outputs) for cell in recorded.record.cells)
    assert [row["verdict"] for row in said["products"]] == ["identical"] * n_products
    made = open_run(studio.folder / "again").cells
    assert [(cell.address, cell.status) for cell in made.values()] == [
        (cell.address, cell.status) for cell in recorded.cells.values()
    ]
    comparison = studio.json("compare", path, "again")
    for section in ("inputs", "parameters"):
        assert all(row["same"] for row in comparison[section])
    # Of a cost that came with a later version, the old record says nothing.
    rows = [(row, row["left"] or row["right"]) for row in comparison["metrics"]]
    assert all(row["same"] for row, side in rows if not side["is_cost"])


def test_reference_records_are_compared(studio: Studio) -> None:
    said = studio.json("compare", REFERENCE / "studio.h5", REFERENCE / "comparison.h5")
    assert [row["same"] for row in said["inputs"] if row["name"] == "number"] == [True]
    assert [(row["cell"], row["verdict"]) for row in said["products"]] == [("survey", "identical")]
    assert {row["cell"] for row in said["cells"] if row["left"] is None} == {
        "guess",
        "paint@paint=plain",
        "paint@paint=dark",
        "paint@paint=spoilt",
    }
