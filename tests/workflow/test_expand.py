"""From steps and variants to cells: addresses, order, seeds, absent data, selections."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import ArgumentError, WorkflowError
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import (
    Cell,
    CellOutput,
    Selection,
    WorkflowInput,
    check_step_names,
    derive_seed,
    expand_cells,
    select_cells,
)
from orthoflow.workflow.views import resolved_json, workflow_from_resolved
from tests.laboratories import GOOD, load

TWO_ORTHOS = """\
orthoflow: 1
seed: 5
inputs:
  scan: {optional: true}
  photos: {optional: true}
steps:
  mosaic: {use: mosaic.seams, in: {layers: ortho.layers}}
  ortho:
    in: {walls: wall.walls, cloud: [cloud.cloud, room.cloud], photos: shots.photos,
         cameras: orient.cameras}
    variants: {backward: {use: ortho.backward}, direct: {use: ortho.direct}}
  orient:
    in: {ties: ties.ties, photos: shots.photos}
    variants: {pnp: {use: orient.pnp}, bundle: {use: orient.bundle}}
  ties: {use: match.sift, in: {photos: shots.photos, walls: wall.walls}}
  wall: {use: raster.grid, in: {cloud: [cloud.cloud, room.cloud], planes: plane.planes}}
  plane:
    in: {cloud: [cloud.cloud, room.cloud]}
    variants: {hough2d: {use: plane.hough2d}, ransac: {use: plane.ransac, repeat: 3}}
  shots: {use: read.photos, in: {files: inputs.photos}}
  cloud: {use: read.scan, in: {files: inputs.scan}}
  room: {use: simulate.room, unless: inputs.scan}
  check:
    use: inspect.truth
    in: {orthoimages: mosaic.orthoimages, walls: wall.walls, truth: room.truth}
"""
COMPARE = "compare: {design: %s, baseline: {plane: ransac}}\n"


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of the workflow of a test; a scan and photos lie beside it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.e57").touch()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").touch()
    return Path("flow.yaml")


def cells_of(
    text: str, write: Path, catalog: Catalog, *inputs: str, selection: Selection | None = None
) -> dict[str, Cell]:
    write.write_text(text)
    workflow = load_workflow(write, catalog, inputs=inputs)
    cells = select_cells(workflow, expand_cells(workflow, catalog), selection or Selection())
    addresses = [cell.address for cell in cells]
    assert len(set(addresses)) == len(addresses)
    for index, cell in enumerate(cells):
        assert set(cell.sources) <= set(addresses[:index])
    return {cell.address: cell for cell in cells}


def addresses(cells: dict[str, Cell], step: str) -> list[str]:
    return [address for address, cell in cells.items() if cell.step == step]


def test_variants_fan_out_downstream_and_shared_prefixes_come_once(
    catalog: Catalog, write: Path
) -> None:
    cells = cells_of(GOOD.replace("  exclude:", "  #"), write, catalog)
    assert addresses(cells, "cloud") == ["cloud"]
    assert addresses(cells, "wall") == ["wall@plane=hough2d", "wall@plane=ransac"]
    assert addresses(cells, "mosaic") == [
        f"mosaic@plane={plane},orient={orient}"
        for plane in ("hough2d", "ransac")
        for orient in ("pnp", "bundle")
    ]
    mosaic = cells["mosaic@plane=ransac,orient=pnp"]
    assert mosaic.assignment == {"plane": "ransac", "orient": "pnp"}
    assert mosaic.inputs == {
        "layers": CellOutput(address="ortho@plane=ransac,orient=pnp", port="layers")
    }
    # An excluded combination is dropped, its parts are kept.
    left = cells_of(GOOD, write, catalog)
    assert {*cells} - {*left} == {
        f"{step}@plane=ransac,orient=pnp" for step in ("orient", "ortho", "mosaic")
    }


def test_one_at_a_time_is_the_baseline_and_every_single_deviation(
    catalog: Catalog, write: Path
) -> None:
    text = TWO_ORTHOS + COMPARE % "one-at-a-time"
    cells = cells_of(text, write, catalog, "scan=a.e57", "photos=photos")
    assert addresses(cells, "mosaic") == [
        "mosaic@plane=ransac,orient=pnp,ortho=backward",
        "mosaic@plane=hough2d,orient=pnp,ortho=backward",
        "mosaic@plane=ransac,orient=bundle,ortho=backward",
        "mosaic@plane=ransac,ortho=direct",
    ]


def test_ignored_ports_multiply_nothing_and_downstream_uses_the_first_repeat(
    catalog: Catalog, write: Path
) -> None:
    text = TWO_ORTHOS + COMPARE % "product"
    cells = cells_of(text, write, catalog, "scan=a.e57", "photos=photos")
    assert addresses(cells, "ortho") == [
        f"ortho@plane={plane},{rest}"
        for plane in ("hough2d", "ransac")
        for rest in ("orient=pnp,ortho=backward", "ortho=direct", "orient=bundle,ortho=backward")
    ]
    assert set(cells["ortho@plane=ransac,ortho=direct"].inputs) == {"walls", "cloud"}
    names = [f"plane@plane=ransac{mark}" for mark in ("", "#1", "#2")]
    repeats = [cells[name] for name in names]
    assert [cell.repeat for cell in repeats] == [0, 1, 2]
    assert [cell.seed for cell in repeats] == [derive_seed(5, "plane.ransac", n) for n in range(3)]
    assert len({cell.seed for cell in repeats}) == 3
    assert not any("#" in source for cell in cells.values() for source in cell.sources)


JUDGED = """\
orthoflow: 1
steps:
  room: {use: simulate.room}
  plane: {use: plane.hough2d, in: {cloud: room.cloud}}
  other: {use: plane.ransac, in: {cloud: room.cloud}, repeat: 3}
  wall: {use: raster.grid, in: {cloud: room.cloud, planes: plane.planes}}
  ortho: {use: ortho.direct, in: {walls: wall.walls, cloud: room.cloud}}
  mosaic: {use: mosaic.seams, in: {layers: ortho.layers}}
  check:
    use: inspect.truth
    in: {orthoimages: mosaic.orthoimages, walls: wall.walls, truth: room.truth,
         planes: other.planes}
"""


def test_repeats_reach_what_lies_between_them_and_an_inspection(
    catalog: Catalog, write: Path
) -> None:
    through_walls = JUDGED.replace("planes: plane.planes", "planes: other.planes")
    for text in (JUDGED, through_walls):
        cells = cells_of(text, write, catalog)
        between = ("wall", "ortho", "mosaic") if text is through_walls else ()
        assert addresses(cells, "room") == ["room"]
        for step in ("other", *between, "check"):
            assert addresses(cells, step) == [step, f"{step}#1", f"{step}#2"]
        for repeat in (1, 2):
            check = cells[f"check#{repeat}"]
            mark = f"#{repeat}" if between else ""
            assert set(check.sources) == {f"mosaic{mark}", f"wall{mark}", "room", f"other#{repeat}"}
            # What differs is what it looks at, not how it looks.
            assert check.seed == cells["check"].seed
    assert str(cells["wall#2"].inputs["planes"]) == "other#2.planes"
    # Those that only time a method reach nothing.
    text = JUDGED.replace("other: {use: plane.ransac", "other: {use: plane.hough2d")
    assert addresses(cells_of(text, write, catalog), "check") == ["check"]


def test_repeats_reach_the_steps_that_the_comparison_names(catalog: Catalog, write: Path) -> None:
    text = JUDGED.replace("planes: plane.planes", "planes: other.planes")
    for metrics, repeated in (
        ("other.rms_mm", "other"),
        ("wall.n_cells, other.rms_mm", "other wall"),
        ("'*.wall_s'", "other wall ortho mosaic check"),
        ("mosaic.*", "other wall ortho mosaic"),
    ):
        cells = cells_of(f"{text}compare: {{metrics: [{metrics}]}}\n", write, catalog)
        assert [cell.step for cell in cells.values() if cell.repeat == 1] == repeated.split()


SEEDED = JUDGED.replace("orthoflow: 1\n", "orthoflow: 1\nseed: {sweep: [1, 2, 3]}\n").replace(
    ", repeat: 3", ""
)


def test_a_sweep_of_seeds_is_a_factor_of_all_that_is_random(catalog: Catalog, write: Path) -> None:
    cells = cells_of(SEEDED, write, catalog)
    for step in ("room", "other", "check"):
        assert addresses(cells, step) == [f"{step}@seed={seed}" for seed in (1, 2, 3)]
    assert cells["other@seed=2"].seed == derive_seed(2, "plane.ransac", 0)
    assert cells["check@seed=2"].assignment == {"seed": "2"}
    assert str(cells["check@seed=2"].inputs["planes"]) == "other@seed=2.planes"
    workflow = load_workflow(write, catalog)
    assert (workflow.seed, workflow.seeds) == (1, (1, 2, 3))
    again = workflow_from_resolved(resolved_json(workflow), workflow.source)
    assert again.seeds == workflow.seeds


def test_seeds_stand_before_variants_and_can_be_left_out(catalog: Catalog, write: Path) -> None:
    variants = "variants: {a: {use: plane.ransac}, b: {use: plane.hough2d}}"
    text = SEEDED.replace("other: {use: plane.ransac,", f"other: {{{variants},")
    cells = cells_of(f"{text}compare: {{exclude: [{{seed: 3, other: b}}]}}\n", write, catalog)
    assert addresses(cells, "other") == [
        *("other@seed=1,other=a", "other@seed=1,other=b"),
        *("other@seed=2,other=a", "other@seed=2,other=b", "other@seed=3,other=a"),
    ]


def test_the_first_present_reference_of_a_list_wins(catalog: Catalog, write: Path) -> None:
    cells = cells_of(TWO_ORTHOS, write, catalog, "scan=a.e57", "photos=photos")
    assert cells["plane@plane=hough2d"].inputs["cloud"] == CellOutput(address="cloud", port="cloud")
    assert cells["cloud"].inputs == {"files": WorkflowInput(name="scan")}
    assert cells["room"].skip_reason == "only without the input scan"
    cells = cells_of(TWO_ORTHOS, write, catalog, "photos=photos")
    assert cells["plane@plane=hough2d"].inputs["cloud"] == CellOutput(address="room", port="cloud")
    assert cells["room"].skip_reason == ""


def test_steps_without_their_data_are_skipped_and_say_which_data(
    catalog: Catalog, write: Path
) -> None:
    cells = cells_of(TWO_ORTHOS, write, catalog)
    reasons = {cell.step: cell.skip_reason for cell in cells.values() if cell.skip_reason}
    behind_photos = ("shots", "ties", "orient", "ortho", "mosaic", "check")
    assert reasons == {
        "cloud": "only with the input scan",
        **dict.fromkeys(behind_photos, "only with the input photos"),
    }
    # A step may wait for an input that its ports do without.
    text = TWO_ORTHOS.replace("unless: inputs.scan}", "if: inputs.photos, unless: inputs.scan}")
    assert cells_of(text, write, catalog, "photos=photos")["room"].skip_reason == ""
    without = cells_of(text, write, catalog, "scan=a.e57")["room"]
    assert without.skip_reason == "only without the input scan"
    # Of its candidates either would do.
    plane = cells_of(text, write, catalog)["plane@plane=hough2d"]
    assert plane.skip_reason == "only with the input scan or with the input photos"


def test_a_skipped_candidate_does_not_multiply_those_who_pass_it_over(
    catalog: Catalog, write: Path
) -> None:
    text = """\
orthoflow: 1
inputs: {photos: {optional: true}}
steps:
  room: {use: simulate.room}
  shots: {use: read.photos, in: {files: inputs.photos}}
  plane: {use: plane.hough2d, in: {cloud: room.cloud}}
  wall: {use: raster.grid, in: {cloud: room.cloud, planes: plane.planes}}
  ties: {use: match.sift, in: {photos: shots.photos, walls: wall.walls}}
  orient:
    in: {ties: ties.ties, photos: shots.photos}
    variants: {pnp: {use: orient.pnp}, bundle: {use: orient.bundle}}
  photo: {use: ortho.backward,
          in: {walls: wall.walls, photos: shots.photos, cameras: orient.cameras}}
  cloud: {use: ortho.direct, in: {walls: wall.walls, cloud: room.cloud}}
  mosaic: {use: mosaic.seams, in: {layers: [photo.layers, cloud.layers]}}
compare: {}
"""
    without = cells_of(text, write, catalog)
    assert addresses(without, "mosaic") == ["mosaic"]
    assert without["mosaic"].inputs == {"layers": CellOutput(address="cloud", port="layers")}
    given = cells_of(text, write, catalog, "photos=photos")
    assert addresses(given, "mosaic") == ["mosaic@orient=pnp", "mosaic@orient=bundle"]


def test_more_combinations_than_anybody_can_run_are_refused(catalog: Catalog, write: Path) -> None:
    variants = ", ".join(f"v{n}: {{use: plane.ransac}}" for n in range(200))
    text = f"""\
orthoflow: 1
steps:
  room: {{use: simulate.room}}
  plane: {{in: {{cloud: room.cloud}}, variants: {{{variants}}}}}
  wall: {{in: {{cloud: room.cloud, planes: plane.planes}},
          variants: {{{variants.replace("plane.ransac", "raster.grid")}}}}}
compare: {{}}
"""
    with pytest.raises(WorkflowError, match=r"20000 step runs or more.*one-at"):
        cells_of(text, write, catalog)


UNTIL_ORTHO = {"cloud", "shots", "plane", "wall", "ties", "first", "reties", "orient", "ortho"}


def test_a_selection_keeps_its_steps_and_what_they_need(catalog: Catalog, write: Path) -> None:
    for selection, steps in (
        (Selection(until=("ties",)), {"cloud", "shots", "plane", "wall", "ties"}),
        # What follows, and what that needs.
        (Selection(from_=("mosaic",)), {*UNTIL_ORTHO, "mosaic"}),
        (Selection(only=("plane",)), {"cloud", "plane"}),
        (Selection(from_=("plane",), until=("wall",)), {"cloud", "plane", "wall"}),
    ):
        cells = cells_of(GOOD, write, catalog, selection=selection)
        assert {cell.step for cell in cells.values()} == steps


def test_a_selected_cell_brings_only_the_variants_it_uses(catalog: Catalog, write: Path) -> None:
    text = TWO_ORTHOS.replace("backward: {use: ortho.backward}, ", "") + COMPARE % "product"
    selection = Selection(only=("ortho",))
    cells = cells_of(text, write, catalog, "scan=a.e57", "photos=photos", selection=selection)
    assert {cell.step for cell in cells.values()} == {"cloud", "plane", "wall", "ortho"}
    assert not any("#" in address for address in cells)


def test_an_unknown_step_of_a_selection_is_refused(catalog: Catalog, write: Path) -> None:
    workflow = load(GOOD, write, catalog)
    with pytest.raises(ArgumentError, match=r"--until wal: .* has no step wal \(did you mean wall"):
        select_cells(workflow, (), Selection(until=("wal",)))
    with pytest.raises(ArgumentError, match=r"--force plan: .* \(did you mean plane\?\)"):
        check_step_names(workflow, ["plan"], "--force")

    message = "no step of workflow palace-room matches all of --from ortho --until wall"
    with pytest.raises(ArgumentError, match=message):
        select_cells(workflow, (), Selection(from_=("ortho",), until=("wall",)))
