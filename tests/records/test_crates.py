"""A run as a Provenance Run Crate, found valid by the official validator, as PROV and as STAC."""

from __future__ import annotations

import dataclasses
import datetime as dt
import hashlib
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pystac
import pytest
import rasterio
from orthoflow_provenance.document import PublishedFile, RecordedFigure
from prov.model import (
    ProvActivity,
    ProvAgent,
    ProvDelegation,
    ProvDerivation,
    ProvDocument,
    ProvEntity,
    ProvGeneration,
    ProvUsage,
)
from pystac.validation import RegisteredValidator

from orthoflow.errors import ArgumentError, RecordError
from orthoflow.files.images import encode_png
from orthoflow.files.publishing import publish_orthoimages
from orthoflow.geometry import WallFrame
from orthoflow.products import Orthoimages
from orthoflow.records.archive import crate_metadata, prov_document, write_crate
from orthoflow.records.open import open_run
from orthoflow.records.runs import Run
from orthoflow.records.stac import write_stac
from orthoflow.records.verify import verify_run
from orthoflow.report import write_page
from tests import samples
from tests.crate_contexts import context_of
from tests.report_runs import cell, record
from tests.studios import Studio, open_studio

PROFILE = "provenance-run-crate-0.5"
PREFIXES = """
PREFIX s: <http://schema.org/>
PREFIX bs: <https://bioschemas.org/>
PREFIX bswf: <https://bioschemas.org/ComputationalWorkflow#>
PREFIX wfrun: <https://w3id.org/ro/terms/workflow-run#>
PREFIX codemeta: <https://codemeta.github.io/terms/>
"""

ORCID = "https://orcid.org/0000-0002-1825-0097"


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """A folder with the crate of a run with an input, a set parameter and a failed cell."""
    with pytest.MonkeyPatch.context() as patch:
        studio = open_studio(tmp_path_factory.mktemp("crates"), patch)
        path = studio.folder / "studio.yaml"
        path.write_text(
            path.read_text() + "  spoil: {use: paint.fail, in: {planes: survey.planes}}\n"
        )
        (studio.folder / "n.txt").write_text("1.5")
        studio(
            *("run", "studio.yaml", "-o", "first", "--input", "number=n.txt"),
            *("--set", "paint.grey=131"),
            code=1,
        )
        studio("export", "first", "--to", "ro-crate", "-o", "crate", code=0)
        yield studio


@pytest.fixture(scope="module")
def crate(studio: Studio) -> dict[str, Any]:
    return json.loads((studio.folder / "crate" / "ro-crate-metadata.json").read_text())  # type: ignore[no-any-return]


def entities(crate: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [entity for entity in crate["@graph"] if kind in entity["@type"]]


def references(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        yield from [value["@id"]] if set(value) == {"@id"} else []
    elif isinstance(value, list):
        for item in value:
            yield from references(item)


def test_every_file_and_reference_is_described_once(studio: Studio, crate: dict[str, Any]) -> None:
    folder = studio.folder / "crate"
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    described = [entity["@id"] for entity in crate["@graph"]]
    assert str(studio.folder) not in (folder / "ro-crate-metadata.json").read_text()
    assert len(set(described)) == len(described)
    assert there <= set(described)
    parts = {part["@id"] for part in entities(crate, "Dataset")[0]["hasPart"]}
    assert there - {"ro-crate-metadata.json"} <= parts
    wanted = {"run.h5", "report.html", "products/paint/wall_0_ortho.tif", "workflow.yaml"}
    assert wanted <= there
    for entity in crate["@graph"]:
        for value in entity.values():
            for found in references(value):
                assert found in described or found.startswith("https://"), (entity["@id"], found)
    stated = {entity["@id"]: entity for entity in entities(crate, "File")}
    for name in there - {"ro-crate-metadata.json"}:
        content = (folder / name).read_bytes()
        assert stated[name]["sha256"] == hashlib.sha256(content).hexdigest()
        assert int(stated[name]["contentSize"]) == len(content)
    [failed] = [entity for entity in entities(crate, "CreateAction") if "spoil" in entity["@id"]]
    assert failed["actionStatus"] == "http://schema.org/FailedActionStatus"
    assert failed["error"] == "no colour sticks to this plane"


def test_the_official_validator_finds_nothing(studio: Studio) -> None:
    # In a process of its own: its libraries warn, patch each other and leave sessions open.
    script = Path(__file__).resolve().parents[1] / "crate_validation.py"
    arguments = [sys.executable, "-W", "ignore", str(script), str(studio.folder / "crate"), PROFILE]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


# The questions of the profile's working group. Question 1 asks for containers, and there are none;
# 3 asks for an `object` of the OrganizeAction, of which the profile's validator says that it must
# not be there (the resolved workflow is an object of the run instead).
QUESTIONS = {
    # 2: how much memory and time?
    """SELECT ?name ?unit ?value WHERE {
        ?action a s:CreateAction; wfrun:resourceUsage ?usage.
        ?usage a s:PropertyValue; s:propertyID ?name; s:unitCode ?unit; s:value ?value }""": 14,
    # 8: what went in?
    """SELECT ?file WHERE { ?action a s:CreateAction; s:instrument ?workflow;
        s:object ?file. ?workflow a bs:ComputationalWorkflow. ?file a s:MediaObject }""": 2,
    # 11: where did parameters of the workflow go?
    """SELECT ?name ?value WHERE {
        ?action a s:CreateAction; s:instrument ?workflow; s:object ?setting.
        ?workflow a bs:ComputationalWorkflow; bswf:input ?given; s:step ?step.
        ?setting s:exampleOfWork ?given.
        ?connection a wfrun:ParameterConnection; wfrun:sourceParameter ?given;
            wfrun:targetParameter ?taken.
        ?tool bswf:input ?taken. ?taken s:name ?name. ?step s:workExample ?tool.
        OPTIONAL { ?setting s:value ?value } }""": 2,
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # rdflib's, of itself
def test_the_questions_of_the_profile_are_answered(crate: dict[str, Any]) -> None:
    import rdflib

    known = [context_of(crate)["@context"], *(x for x in crate["@context"] if isinstance(x, dict))]
    text = json.dumps({**crate, "@context": known})
    graph = rdflib.Graph().parse(data=text, format="json-ld", publicID="http://crate.test/")
    for question, n_answers in QUESTIONS.items():
        assert len(list(graph.query(PREFIXES + question))) == n_answers, question


@pytest.mark.parametrize(
    ("author", "identifier", "name"),
    [
        ("A. Nemo", "#author", "A. Nemo"),
        (ORCID, ORCID, ORCID),
        (f"A. Nemo, {ORCID}", ORCID, "A. Nemo"),
        (f"{ORCID} A. Nemo", "#author", f"{ORCID} A. Nemo"),
    ],
)
def test_who_made_it_is_told_where_it_is_given(
    studio: Studio, crate: dict[str, Any], author: str, identifier: str, name: str
) -> None:
    assert "author" not in entities(crate, "Dataset")[0]
    assert entities(crate, "Person") == []
    record = open_run(studio.folder / "first").record
    metadata: dict[str, Any] = crate_metadata(record, [], license_text="CC0", author=f" {author} ")
    assert entities(metadata, "Dataset")[0]["license"] == "CC0"
    assert entities(metadata, "Person") == [{"@id": identifier, "@type": "Person", "name": name}]
    assert entities(metadata, "Dataset")[0]["author"] == {"@id": identifier}


def test_products_that_the_record_holds_are_part_of_it(studio: Studio) -> None:
    run = open_run(studio.folder / "first").record
    survey = run.cells[0]
    for is_embedded, part in ((False, None), (True, {"@id": "run.h5"})):
        planes = replace(survey.outputs["planes"], embedded=is_embedded)
        cells = (replace(survey, outputs={"planes": planes}), *run.cells[1:])
        graph: dict[str, Any] = crate_metadata(replace(run, cells=cells), [], license_text="CC0")
        [found] = [one for one in graph["@graph"] if one.get("identifier") == planes.digest]
        assert found.get("isPartOf") == part
    with pytest.raises(
        RecordError, match=r"survey\.planes was used, but no executed step produced"
    ):
        crate_metadata(replace(run, cells=run.cells[1:]), [], license_text="none")


def test_what_the_report_links_to_is_in_the_crate(studio: Studio, tmp_path: Path) -> None:
    run = open_run(shutil.copytree(studio.folder / "first", tmp_path / "drawn"))
    pixel = encode_png(np.zeros((1, 1, 3), dtype=np.uint8))
    figure = RecordedFigure(name="dot", caption="A dot.", media_type="image/png", data=pixel)
    cells = tuple(replace(one, figures=(figure,)) for one in run.record.cells)
    run = replace(run, record=replace(run.record, cells=cells))
    write_page(run, run.folder / "report.html")
    folder = tmp_path / "crate"
    folder.mkdir()
    write_crate(run, folder)
    page = (folder / "report.html").read_text(encoding="utf-8")
    links = {unquote(link) for link in re.findall(r'href="([^"#:]+)"', page)}
    assert any(link.startswith("figures/") for link in links)
    assert [link for link in sorted(links) if not (folder / link).is_file()] == []
    metadata = json.loads((folder / "ro-crate-metadata.json").read_text(encoding="utf-8"))
    assert links <= {entity["@id"] for entity in entities(metadata, "File")}


def test_changed_files_of_a_crate_are_found(studio: Studio, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(studio.folder / "crate", tmp_path / "crate"))
    metadata, (packages,) = folder / "ro-crate-metadata.json", folder.glob("requirements-*.txt")
    found = verify_run(folder)
    assert (found.findings, found.notes) == ((), ())
    assert found.unchecked == ("ro-crate-metadata.json (author, license and descriptions)",)
    digest = hashlib.sha256((folder / "products" / "metrics.csv").read_bytes()).hexdigest()
    metadata.write_text(metadata.read_text().replace(digest, digest[::-1]))
    for path in (folder / "workflow.yaml", packages, folder / "figures" / "graph.svg"):
        path.write_bytes(path.read_bytes() + b"\n")
    (folder / "workflow-resolved.json").unlink()
    (folder / "more.txt").touch()
    found = verify_run(folder)
    assert sorted(found.findings) == [
        "figures/graph.svg: differs from ro-crate-metadata.json",
        "products/metrics.csv: differs from ro-crate-metadata.json",
        f"{packages.name}: differs from the record",
        "workflow.yaml: differs from the record",
    ]
    assert [note.text for note in found.notes] == [
        "1 files of the crate are missing: workflow-resolved.json"
    ]
    assert found.unchecked[0] == "more.txt"
    crate = json.loads((studio.folder / "crate" / metadata.name).read_text())
    stated = {entity["@id"]: entity for entity in crate["@graph"]}
    crate["@graph"].append({"@id": "#me", "@type": "Person", "name": "A. Nemo"})
    stated["./"] |= {"license": "CC0", "author": {"@id": "#me"}, "description": "A wall."}
    stated["./"]["hasPart"].reverse()
    metadata.write_text(json.dumps(crate))
    assert not [text for text in verify_run(folder).findings if text.startswith(metadata.name)]
    stated["./"]["datePublished"] = "2020-01-01"
    stated["#engine"]["softwareVersion"] = "9"
    stated["#setting-paint/grey"]["value"] = 132
    stated["#run-of-paint"]["startTime"] = "2020-01-01"
    crate["@graph"].append({"@id": "#metric-paint/iou", "@type": "PropertyValue", "value": 0.999})
    metadata.write_text(json.dumps(crate))
    [text] = [text for text in verify_run(folder).findings if text.startswith(metadata.name)]
    assert text == (
        "ro-crate-metadata.json: differs from the record in ./ datePublished, "
        "#engine softwareVersion, #run-of-paint startTime and 2 more"
    )


def test_tables_hold_what_the_record_says(studio: Studio) -> None:
    import csv

    studio("export", "first", "--to", "csv", code=0)
    folder = studio.folder / "first" / "export" / "csv"

    def table(name: str) -> list[dict[str, str]]:
        with (folder / name).open(newline="") as file:
            return list(csv.DictReader(file))

    assert [(row["cell"], row["status"]) for row in table("cells.csv")] == [
        ("survey", "ok"),
        ("paint", "ok"),
        ("spoil", "failed"),
    ]
    grey = [row for row in table("parameters.csv") if row["parameter"] == "grey"]
    assert [(row["cell"], row["value"], row["is_set"]) for row in grey] == [
        ("paint", "131", "1"),
        ("spoil", "128", "0"),
    ]
    assert [row["file"] for row in table("inputs.csv")] == ["n.txt"]
    assert (folder / "metrics.csv").read_bytes() == (
        studio.folder / "first" / "products" / "metrics.csv"
    ).read_bytes()
    assert {row["name"] for row in table("environments.csv")} > {"python", "cpu", "numpy"}
    assert studio("export", "first", "--to", "csv").exit_code == 2  # the folder is not empty


# The same run for the PROV model ------------------------------------------------------------------


def test_the_graph_of_a_run_is_read_by_the_prov_package(studio: Studio) -> None:
    studio("export", "first", "--to", "prov", code=0)
    text = (studio.folder / "first" / "export" / "prov" / "prov.json").read_text()
    record = open_run(studio.folder / "first").record
    json.loads(text, parse_constant=pytest.fail)  # as JSON has it, without NaN
    document = ProvDocument.deserialize(content=text, format="json")
    executed = [step for step in record.cells if step.status != "skipped"]
    activities = {str(a.identifier): a for a in document.get_records(ProvActivity)}
    assert set(activities) == {f"cell:{step.address}" for step in executed}
    for step in executed:
        activity = activities[f"cell:{step.address}"]
        facts = {str(name): value for name, value in activity.attributes}
        assert facts["orthoflow:method"] == step.method
        assert facts["orthoflow:status"] == step.status
        assert activity.get_startTime() == dt.datetime.fromisoformat(step.started)
        assert activity.get_endTime() == dt.datetime.fromisoformat(step.ended)
        for name, value in step.params.items():
            if isinstance(value, int | float):
                assert facts[f"parameter:{name}"] == value
    outputs = {
        f"product:{step.address}.{port}": product.digest
        for step in executed
        for port, product in step.outputs.items()
    }
    entities = {str(e.identifier): e for e in document.get_records(ProvEntity)}
    generated = {str(g.args[0]): str(g.args[1]) for g in document.get_records(ProvGeneration)}
    for name, digest in outputs.items():
        assert {str(k): v for k, v in entities[name].attributes}["orthoflow:digest"] == digest
        assert generated[name] == f"cell:{name.removeprefix('product:').rpartition('.')[0]}"
    published = {name for name in entities if name.startswith("published:")}
    # The tables of all metrics and of all walls are of no cell.
    assert {name.count("%2F") for name in published - set(generated)} == {1}
    # Everything that is used, or that something comes of, is an entity that is there.
    ends = [str(u.args[1]) for u in document.get_records(ProvUsage)]
    ends += [str(d.args[1]) for d in document.get_records(ProvDerivation)]
    assert ends
    assert set(ends) <= set(entities)
    agents = {str(a.identifier) for a in document.get_records(ProvAgent)}
    assert len(agents) >= 2
    assert {str(d.args[1]) for d in document.get_records(ProvDelegation)} <= agents


@pytest.mark.parametrize("strange", ["a b", "x:y", "../../etc", 'é\n#%41"'])
def test_strange_names_stay_names(studio: Studio, strange: str) -> None:
    record = open_run(studio.folder / "first").record
    first = record.cells[0]
    step = dataclasses.replace(
        first,
        address=strange,
        params={strange: [1, None, {"a": 2}], "none": None, "nan": math.nan, "large": 10**30},
    )
    changed = dataclasses.replace(record, run_id=strange, cells=(step,), published=())
    text = prov_document(changed).serialize(format="json")
    document = ProvDocument.deserialize(content=text, format="json")
    (activity,) = document.get_records(ProvActivity)
    facts = {str(name): value for name, value in activity.attributes}
    assert facts["prov:label"] == strange
    assert '[1, null, {"a": 2}]' in facts.values()
    assert facts["parameter:none"] == "null"
    assert math.isnan(facts["parameter:nan"])
    assert facts["parameter:large"] == 10**30


# Orthoimages as a STAC catalogue ------------------------------------------------------------------


SOUTH, UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
EAST, NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def orthoimages() -> Orthoimages:
    """A wall in its own plane, and a floor in UTM 32 near Munich."""
    corner = np.array([691_000.0, 5_334_000.0, 520.0])
    shared: dict[str, Any] = {"origin_world": corner, "u_world": EAST}
    wall = WallFrame(**shared, v_world=-UP, normal_world=SOUTH, gsd_m=0.01, width=60, height=40)
    floor = WallFrame(
        **shared,
        v_world=-NORTH,
        normal_world=UP,
        gsd_m=0.02,
        width=50,
        height=30,
        map_crs="EPSG:25832",
    )
    return Orthoimages(
        images=tuple(
            samples.orthoimage(
                frame,
                wall=k,
                name=name,
                rgb=np.full((*frame.shape, 3), 90, np.uint8),
                mask=np.ones(frame.shape, np.uint8),
            )
            for k, (frame, name) in enumerate([(wall, "wall 0"), (floor, "floor 1")])
        )
    )


@pytest.fixture
def finished(tmp_path: Path) -> Run:
    folder = tmp_path / "run" / "products" / "mosaic"
    folder.mkdir(parents=True)
    publish_orthoimages(orthoimages(), folder, "sha256:" + "0" * 64)
    published = tuple(
        PublishedFile(
            path=f"products/mosaic/{path.name}",
            size_bytes=path.stat().st_size,
            sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        )
        for path in sorted(folder.iterdir())
    )
    made = cell("mosaic", ended="2026-01-02T03:04:05.000Z")
    return Run(path=tmp_path / "run" / "run.h5", record=record([made], published=published))


def test_the_collection_is_valid_and_places_what_is_on_earth(finished: Run, tmp_path: Path) -> None:
    folder = tmp_path / "stac"
    folder.mkdir()
    assert write_stac(finished, folder) == 2
    collection = pystac.Collection.from_file(str(folder / "collection.json"))
    core = RegisteredValidator.get_validator()
    parsed = json.loads((folder / "collection.json").read_text())
    core.validate_core(parsed, pystac.STACObjectType.COLLECTION, "1.1.0")
    items = {item.id: item for item in collection.get_items()}
    assert set(items) == {"mosaic.wall_0_ortho", "mosaic.wall_1_ortho"}
    for item in items.values():
        parsed = json.loads(Path(item.self_href).read_text())
        core.validate_core(parsed, pystac.STACObjectType.ITEM, "1.1.0")
        asset = item.assets["image"]
        href = asset.get_absolute_href()
        assert href is not None
        content = Path(href).read_bytes()
        assert asset.extra_fields["file:checksum"] == f"1220{hashlib.sha256(content).hexdigest()}"
        assert asset.extra_fields["file:size"] == len(content)
        assert item.properties["processing_digest"] == f"sha256:{64 * '0'}"
        assert item.properties["gsd"] in (0.01, 0.02)
        with rasterio.open(href) as raster:
            assert item.properties["proj:shape"] == list(raster.shape)
            assert item.properties["proj:transform"] == list(raster.transform)[:6]
    wall, floor = items["mosaic.wall_0_ortho"], items["mosaic.wall_1_ortho"]
    assert (wall.geometry, wall.bbox) == (None, None)
    assert wall.properties["proj:code"] is None
    assert floor.properties["proj:code"] == "EPSG:25832"
    # 191 km / 0.9996 east of 9 degrees, over 6390 km * cos(48.15 deg), less 5 of 10,000.
    assert floor.bbox == pytest.approx([11.567, 48.131, 11.567, 48.131], abs=1e-3)
    assert (floor.properties["proj:wkt2"] or "").startswith("PROJCRS")
    (outline,) = (floor.geometry or {})["coordinates"]
    assert len(outline) == 5
    assert (min(outline)[0], max(outline)[0]) == (floor.bbox[0], floor.bbox[2])
    for path in folder.rglob("*.item.json"):
        text = path.read_text()
        assert str(tmp_path) not in text
        for link in json.loads(text)["links"]:
            assert (path.parent / link["href"]).resolve() == folder / "collection.json"
    assert collection.extent.spatial.bboxes == [floor.bbox]


def test_a_run_without_orthoimages_says_so(finished: Run, tmp_path: Path) -> None:
    for path in finished.folder.rglob("*_ortho.tif"):
        path.unlink()
    with pytest.raises(ArgumentError, match="has no orthoimages among its published files"):
        write_stac(finished, tmp_path)
