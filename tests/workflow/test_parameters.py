"""Parameters: `--set`, files of them, sweeps, and how values are written."""

from __future__ import annotations

import itertools
import json
import math
import re
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.discovery import NAME_PATTERN
from orthoflow.files.documents import meant_number, meant_parameter
from orthoflow.products.product import JsonValue
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.expand import expand_cells, swept_indices
from orthoflow.workflow.model import Workflow
from orthoflow.workflow.parameters import variant_names
from orthoflow.workflow.source import InvalidWorkflowError
from orthoflow.workflow.views import resolved_json
from tests.laboratories import GOOD, SWEPT, load

LIMITS = {"low_m": 0.5, "high_m": 1.0}
# `--set` -> step, variant and value; the method names a step without variants, too.
SETS = {
    "wall.gsd_m=0.002": ("wall", "", 0.002),
    "wall.grid.gsd_m=2": ("wall", "", 2.0),
    "plane.ransac.iterations=7": ("plane", "ransac", 7),
    "plane.hough2d.normal=[1, 0, 0]": ("plane", "hough2d", [1.0, 0.0, 0.0]),
    "cloud.up=y": ("cloud", "", "y"),
    "plane.hough2d.limits.low_m=0.5": ("plane", "hough2d", LIMITS),
    "plane.limits.low_m=0.5": ("plane", "hough2d", LIMITS),
}


def test_set_overrides_a_parameter_and_is_kept(catalog: Catalog, write: Path) -> None:
    for text, (step, variant, value) in SETS.items():
        workflow = load(GOOD, write, catalog, text)
        call = workflow.steps[step].variant(variant)
        parameter = next(name for name in call.params_set if f".{name}" in text)
        assert call.params[parameter] == value
        assert workflow.overrides == (f"--set {text}",)


def test_parameters_that_disagree_are_told_where_the_method_stands(
    catalog: Catalog, write: Path
) -> None:
    text = GOOD.replace("use: plane.hough2d, params: {cell_m: 0.02}", "use: plane.hough2d")
    with pytest.raises(InvalidWorkflowError) as caught:
        load(text, write, catalog, "plane.hough2d.cell_m=0.06")
    (problem,) = caught.value.problems
    line = 1 + text.splitlines().index("      hough2d: {use: plane.hough2d}")
    assert (problem.line, problem.path) == (line, "steps.plane.variants.hough2d.params")
    assert problem.message.endswith("cell_m 0.06 must not exceed tolerance_m")


# --- sweeps ---


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def load_swept(catalog: Catalog, text: str = SWEPT, **options: object) -> Workflow:
    Path("swept.yaml").write_text(text, encoding="utf-8")
    return load_workflow("swept.yaml", catalog, **options)  # type: ignore[arg-type]


def values_of(workflow: Workflow, parameter: str = "tolerance_m") -> dict[str, object]:
    return {one.name: one.params[parameter] for one in workflow.steps["plane"].variants}


def test_each_value_is_a_variant_whose_name_says_it(catalog: Catalog) -> None:
    workflow = load_swept(catalog)
    names = ("tolerance_m-0_02", "tolerance_m-0_05", "tolerance_m-0_1")
    assert values_of(workflow) == dict(zip(names, (0.02, 0.05, 0.1), strict=True))
    assert {one.params_set["cell_m"] for one in workflow.steps["plane"].variants} == {0.01}


TWO = (
    SWEPT[: SWEPT.index("    use: plane.hough2d")]
    + """\
    in: {cloud: room.cloud}
    variants:
      hough2d: {use: plane.hough2d, params: {tolerance_m: {sweep: [0.02, 0.05]}}}
      ransac: {use: plane.ransac, params: {tolerance_m: {sweep: [0.02, 0.05]}}}
compare: {baseline: {plane: hough2d-tolerance_m-0_05},
          exclude: [{plane: ransac-tolerance_m-0_02}]}
"""
)


def test_a_value_that_is_not_swept_any_more_stands_for_its_variant(catalog: Catalog) -> None:
    one = load_swept(catalog, TWO, sets=["plane.hough2d.tolerance_m=0.03"])
    assert one.baseline == {"plane": "hough2d"}
    assert one.compare is not None
    assert one.compare.exclude == ({"plane": "ransac-tolerance_m-0_02"},)
    # What was to be left out of a sweep is no reason to leave out its only value.
    other = load_swept(catalog, TWO, sets=["plane.ransac.tolerance_m=0.03"])
    assert other.compare is not None
    assert other.compare.exclude == ()
    assert other.baseline == {"plane": "hough2d-tolerance_m-0_05"}
    alone = f"{SWEPT}compare: {{baseline: {{plane: tolerance_m-0_05}}}}\n"
    assert load_swept(catalog, alone, sets=["plane.tolerance_m=0.03"]).baseline == {}
    with pytest.raises(InvalidWorkflowError, match="has no variant ransac-tolerance_m-0_07"):
        load_swept(catalog, TWO.replace("hough2d-tolerance_m-0_05}", "ransac-tolerance_m-0_07}"))


def test_a_remedy_names_a_swept_variant_as_set_takes_it(catalog: Catalog) -> None:
    for text, setting in ((TWO, "plane.hough2d"), (SWEPT, "plane")):
        cells = expand_cells(load_swept(catalog, text), catalog)
        assert setting in {cell.setting for cell in cells if cell.step == "plane"}
        load_swept(catalog, text, sets=[f"{setting}.tolerance_m=0.03"])


def test_a_value_takes_the_place_of_a_sweep_and_a_sweep_that_of_a_value(catalog: Catalog) -> None:
    plain = load_swept(catalog, sets=["plane.tolerance_m=0.03"])
    assert values_of(plain) == {"": 0.03}
    assert plain.compare is None
    sets = ["plane.tolerance_m=0.03", "plane.cell_m={sweep: [0.001, 0.002]}"]
    other = load_swept(catalog, sets=sets)
    assert values_of(other, "cell_m") == {"cell_m-0_001": 0.001, "cell_m-0_002": 0.002}
    again = load_swept(catalog, sets=["plane.hough2d.tolerance_m.sweep=[0.5, 0.6]"])
    assert list(values_of(again).values()) == [0.5, 0.6]
    beside = load_swept(catalog, sets=["plane.cell_m=0.005"])
    assert set(values_of(beside, "cell_m").values()) == {0.005}
    assert len(beside.steps["plane"].variants) == 3


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ([0.1, 0.10000001], ["p-0_1", "p-0_10000001"]),
        ([0.25, 1e-7, -1.5], ["p-0_25", "p-1em07", "p-m1_5"]),
        ([1.0, 20, True, None], ["p-1", "p-20", "p-true", "p-none"]),
        ([[1, 0], [0.5, 1]], ["p-1-0", "p-0_5-1"]),
        # What no name can state exactly gets an index.
        (["Fast Mode!", "fast mode"], ["sweep-1", "sweep-2"]),
        ([{"k": 1}, {"k": 2}], ["sweep-1", "sweep-2"]),
        ([[1, [2, 3]], [[1, 2], 3]], ["sweep-1", "sweep-2"]),
        (["x" * 40, "y"], ["sweep-1", "sweep-2"]),
        ([0.1, "0_1"], ["sweep-1", "sweep-2"]),
        ([3, "a b", 1], ["sweep-2", "sweep-3", "sweep-1"]),
    ],
)
def test_a_name_states_its_value_exactly_or_is_an_index_whatever_the_order(
    values: list[JsonValue], names: list[str]
) -> None:
    made = dict(zip(names, values, strict=True))
    for order in itertools.permutations(values[:4]):
        one = [{"p": value} for value in (*order, *values[4:])]
        found = variant_names("", one)
        assert {name: row["p"] for name, row in zip(found, one, strict=True)} == made
        assert all(re.fullmatch(NAME_PATTERN, name) for name in found)


def test_an_index_is_explained_by_its_values(catalog: Catalog) -> None:
    swept = (
        "{cell_m: {sweep: [0.01, 0.02]}, normal: {sweep: [[0, 0, 1], [1.23456, 0.23456, 0.12345]]}}"
    )
    text = re.sub(r"params: \{.*\}\}", f"params: {swept}", SWEPT)
    workflow = load_swept(catalog, text)
    assert swept_indices(workflow)[0] == ("plane=sweep-1", "cell_m 0.01, normal [0, 0, 1]")
    assert len(swept_indices(workflow)) == 4
    assert swept_indices(load_swept(catalog)) == []


# --- files of parameters ---


def test_a_file_of_parameters_is_gone_before_by_what_is_set(
    catalog: Catalog, tmp_path: Path
) -> None:
    (tmp_path / "fine.yaml").write_text("plane.cell_m: 0.004\nwall.gsd_m: 0.002\n")
    finer = "plane.cell_m: 0.003\nplane.tolerance_m: {sweep: [1, 2]}\n"
    (tmp_path / "finer.yaml").write_text(finer)
    workflow = load_swept(catalog, set_files=["fine.yaml", "finer.yaml"], sets=["wall.gsd_m=0.001"])
    assert set(values_of(workflow, "cell_m").values()) == {0.003}
    assert list(values_of(workflow).values()) == [1, 2]
    assert workflow.steps["wall"].variant("").params["gsd_m"] == 0.001
    # The record says what the files said, not where they lie.
    assert json.loads(resolved_json(workflow))["overrides"] == [
        "--set plane.cell_m=0.004",
        "--set wall.gsd_m=0.002",
        "--set plane.cell_m=0.003",
        '--set plane.tolerance_m={"sweep": [1, 2]}',
        "--set wall.gsd_m=0.001",
    ]


# --- how values are written ---


def test_a_number_in_words_gets_its_value() -> None:
    for parameter, text, said in (
        ("gsd_m", "0,003", "; write a decimal point: 0.003"),
        ("gsd_m", "3mm", "; write it in metres, without a unit: 0.003"),
        ("gsd_m", "0,5 cm", "; write it in metres, without a unit: 0.005"),
        ("max_tilt_deg", "10°", "; write it in degrees, without a unit: 10"),
        ("noise_mm", "0.002 m", "; write it in millimetres, without a unit: 2"),
        ("min_share", "5 m", "; write numbers without a unit"),
        ("gsd_m", "0.003", "; write it without quotes"),
        *(("gsd_m", odd, "") for odd in ("fine", "1.2.3", [1])),
    ):
        assert meant_number(parameter, text) == said


def test_a_name_with_another_unit_is_led_to_ours() -> None:
    for name, value, said in (
        ("gsd_mm", 50, " (it is gsd_m, in metres: gsd_m: 0.05)"),
        ("gsd_cm", "5", " (it is gsd_m, in metres)"),
        ("tilt_rad", math.pi, " (it is tilt_deg, in degrees: tilt_deg: 180)"),
        ("gsd_mm", True, " (it is gsd_m, in metres)"),
        *(("gsd_m", 1, ""), ("mm", 1, "")),
    ):
        assert meant_parameter(name, ["crs", "gsd_m", "tilt_deg"], value) == said
