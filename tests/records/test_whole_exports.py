"""A record as tables and as a crate, to the last letter; and the order of published files."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import pytest

from orthoflow.records.crates import NO_LICENSE, write_crate
from orthoflow.records.published import _by_number, cell_metrics, publish_products, published_files
from orthoflow.records.runs import Run
from orthoflow.records.tables import write_csv_tables
from orthoflow.records.unfinished import open_run
from tests.provenance_records import sample_record, write_sample

CLOUD, WALLS, ENVIRONMENT = "sha256:" + "c" * 64, "sha256:" + "d" * 64, "sha256:" + "e" * 64
WALL = '"wall@plane=hough2d,orient=pnp#2"'


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(path=tmp_path / "run.h5", record=sample_record(CLOUD, WALLS))


def rows(*texts: str) -> list[list[str]]:
    return list(csv.reader("\n".join(texts).splitlines()))


def test_tables_hold_a_line_per_fact(run: Run) -> None:
    written = write_csv_tables(run, run.folder)
    assert [path.name for path in written] == [
        *("metrics.csv", "cells.csv", "parameters.csv", "inputs.csv", "products.csv"),
        "environments.csv",
    ]
    texts = {path.name: rows(path.read_text()) for path in written}
    first, second, third = run.record.cells
    # Nothing is known of what the results take in the store, and of the time to load.
    spent = "2025-01-02T03:04:05Z,2025-01-02T03:04:06Z,1.5,2.5,64.0,,,"
    built_in = "orthoflow-tls,0.1.0,1,exact"
    assert texts["cells.csv"] == rows(
        *[
            (
                "cell,step,variants,repeat,status,method,distribution,distribution_version,"
                "result_version,determinism,seed,started,ended,wall_s,cpu_s,peak_rss_mib,stored_mib,"
                "compile_s,"
                "environment,cached_from,key,error_type,error_message,warnings"
            ),
            f"cloud,cloud,,0,ok,read.scan,{built_in},,{spent}{ENVIRONMENT},earlier-run,{first.key},,,",
            (
                f'{WALL},wall,"plane=hough2d,orient=pnp",2,ok,raster.grid,{built_in},{2**100 + 1},'
                f"{spent}{ENVIRONMENT},,{second.key},,,the scan has no intensity"
            ),
            (
                f"ortho,ortho,,0,failed,{third.method},,,{third.result_version},{third.determinism}"
                ",,,,0.0,0.0,0.0,,,,,,MethodError,no cell has enough points,"
            ),
        ]
    )
    parameters = "gsd_m,0.01,1\n", 'windows,"[3, 5, 7]",0\n', "label,null,0\n"
    assert texts["parameters.csv"] == rows(
        "cell,method,parameter,value,is_set\n"
        + "".join(
            f"{cell},{line}"
            for cell in ("cloud,read.scan", f"{WALL},raster.grid")
            for line in parameters
        )
    )
    (file,) = run.record.inputs[0].files
    assert texts["inputs.csv"] == rows(
        f"input,file,size_bytes,sha256\nscan,hall.laz,{2**40},{file.sha256}\n"
    )
    assert texts["products.csv"] == rows(
        "cell,direction,port,type,encoding_version,digest,source\n"
        f"cloud,out,cloud,cloud,1,{CLOUD},\n"
        f"{WALL},in,cloud,cloud,1,{CLOUD},cloud.cloud\n"
        f"{WALL},out,walls,walls,1,{WALLS},\n"
    )
    assert texts["environments.csv"] == rows(
        "environment,name,version\n"
        + "".join(
            f"{ENVIRONMENT},{line}\n"
            for line in (
                *("python,3.11.7", "os,Linux 6.1", "cpu,A processor", "cores,2", "threads,2"),
                *("git_commit,", "numpy,2.4.0", "h5py,3.16.0"),
            )
        )
    )
    costs = ("wall_s,1.5,s", "cpu_s,2.5,s", "peak_rss_mib,64.0,MiB")
    assert texts["metrics.csv"] == rows(
        "cell,step,method,metric,value,unit\n"
        + "".join(
            f"{line}\n"
            for line in (
                *(f"cloud,cloud,read.scan,{cost}" for cost in costs),
                f"{WALL},wall,raster.grid,rms_mm,1.25,mm",
                f"{WALL},wall,raster.grid,cells,5400.0,1",
                *(f"{WALL},wall,raster.grid,{cost}" for cost in costs),
            )
        )
    )
    assert cell_metrics(run.record.cells[2]) == ()


def test_published_files_come_by_number(run: Run) -> None:
    store = run.folder / "store"
    store.mkdir()
    names = ("wall_10.tif", "wall_2.tif", "2.tif", "a.txt")
    for name in names:
        (store / name).write_text(name)
    first = {store / name: hashlib.sha256(name.encode()).hexdigest() for name in names}
    more = {store / names[0]: first[store / names[0]]}
    files = {"cloud": {"cloud": first, "more": more}, "ortho": {"x": first}}
    (run.folder / "products").mkdir()
    (run.folder / "products" / "old").touch()
    found = publish_products(run.folder, run.record.cells, files, "r")
    there = [path.name for path in published_files(run.folder, "cloud")]
    assert there == [
        *("2.tif", "a.txt", "metrics.csv", "more_wall_10.tif", "wall_2.tif", "wall_10.tif"),
    ]
    assert published_files(run.folder, "ortho") == ()
    assert [file.path for file in found] == sorted(file.path for file in found)
    assert {file.path for file in found} == {
        *(f"products/cloud/{name}" for name in there),
        "products/metrics.csv",
        "products/wall@plane=hough2d,orient=pnp#2/metrics.csv",
    }
    sizes = {file.path: file.size_bytes for file in found}
    assert sizes["products/cloud/wall_2.tif"] == len("wall_2.tif")
    assert _by_number("a2b10") == (("a", 2), ("b", 10), ("", 0))


def test_a_crate_describes_each_part_of_a_record_once(tmp_path: Path) -> None:
    path, record, shelf = write_sample(tmp_path)
    folder = tmp_path / "crate"
    folder.mkdir()
    write_crate(open_run(path), folder, license_text=NO_LICENSE)
    graph = json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    # What all crates have is asked of by their validator.
    common = ("ro-crate-metadata.json", "./", "https:", "ni:", "requirements-", "#orthoflow-")
    told = {item["@id"]: item.get("name") for item in graph if not item["@id"].startswith(common)}
    wall = "wall@plane=hough2d,orient=pnp#2"
    workflow, scan, grid = "workflow.yaml", "#method-read.scan", "#method-raster.grid"
    first, second = (digest.removeprefix("sha256:") for digest in shelf.files)
    params = ("gsd_m", "label", "windows")
    costs = ("wall_s", "cpu_s", "peak_rss_mib")
    connections = (
        f"{workflow}#cloud-{workflow}#cloud/gsd_m-{scan}/gsd_m",
        f"{workflow}#wall-{scan}/out/cloud-{grid}/cloud",
        f"{workflow}#wall-{workflow}#wall/gsd_m-{grid}/gsd_m",
    )
    actions = {"cloud": "read.scan", wall: "raster.grid", "ortho": "ortho.pointcloud-direct"}
    assert told == {
        workflow: "court-yard",
        **{f"{workflow}#{step}": step for step in ("cloud", "wall", "ortho")},
        **{f"#connection-{connection}": None for connection in connections},
        f"{workflow}#inputs/scan": "scan",
        f"{workflow}#cloud/gsd_m": "cloud.gsd_m",
        f"{workflow}#wall/gsd_m": "wall.gsd_m",
        f"{workflow}#out/{wall}.walls": f"{wall}.walls",
        f"#to-{workflow}#out/{wall}.walls": None,
        "workflow-resolved.json": "workflow-resolved.json",
        "run.h5": "run.h5",
        f"#product-{first}": "cloud of cloud",
        f"#product-{second}": f"walls of {wall}",
        "#run": "run 20250102-abc of court-yard",
        "#orchestration": "orchestrate court-yard with orthoflow 0.1.0",
        "#engine": "orthoflow",
        **{f"#method-{method}": method for method in actions.values()},
        **{f"{method}/{name}": name for method in (scan, grid) for name in params},
        f"{scan}/out/cloud": "cloud",
        f"{grid}/cloud": "cloud",
        f"{grid}/out/walls": "walls",
        "#distribution-orthoflow-tls": "orthoflow-tls",
        # A cell that failed before its method was found.
        "#distribution-": "",
        **{f"#run-of-{cell}": f"{method} as {cell}" for cell, method in actions.items()},
        **{f"#control-of-{cell}": f"orchestrate {cell}" for cell in actions},
        **{f"#setting-{cell}/{name}": name for cell in ("cloud", wall) for name in params},
        **{f"#cost-{cell}/{name}": name for cell in actions for name in costs},
        **{f"#metric-{wall}/{name}": name for name in ("rms_mm", "cells")},
    }
    values = {item["@id"]: item["value"] for item in graph if "value" in item}
    assert values[f"#setting-{wall}/windows"] == "[3, 5, 7]"
    assert values[f"#metric-{wall}/rms_mm"] == 1.25
    assert values["#cost-cloud/cpu_s"] == "2.5"
    names = [item.get("name") for item in graph if item["@id"].startswith("ni:")]
    assert names == [file.name for file in record.inputs[0].files]
