"""Sweeps: the variants that they become, what takes their place, and what is wrong with them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from orthoflow.catalog.catalog import Catalog
from orthoflow.errors import ArgumentError
from orthoflow.workflow import sweeps
from orthoflow.workflow.cells import expand_cells
from orthoflow.workflow.document import load_workflow
from orthoflow.workflow.format import Workflow
from orthoflow.workflow.problems import InvalidArgumentsError, InvalidWorkflowError
from orthoflow.workflow.resolved import resolved_json, workflow_from_resolved
from orthoflow.workflow.schema import workflow_schema
from tests.laboratories import laboratory_catalog

ROOM = """\
orthoflow: 1
name: swept
inputs:
  scan: {optional: true}
steps:
  room: {use: simulate.room}
  cloud: {use: read.scan, in: {files: inputs.scan}}
  plane:
    use: plane.hough2d
    in: {cloud: room.cloud}
    params: {cell_m: 0.01, tolerance_m: {sweep: [0.02, 0.05, 0.1]}}
  wall: {use: raster.grid, in: {cloud: room.cloud, planes: plane.planes}}
"""


@pytest.fixture
def catalog(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Catalog:
    monkeypatch.chdir(tmp_path)
    return laboratory_catalog(monkeypatch)


def load(catalog: Catalog, text: str = ROOM, **options: object) -> Workflow:
    Path("swept.yaml").write_text(text, encoding="utf-8")
    return load_workflow("swept.yaml", catalog, **options)  # type: ignore[arg-type]


def values(workflow: Workflow, parameter: str = "tolerance_m") -> dict[str, object]:
    return {one.name: one.params[parameter] for one in workflow.steps["plane"].variants}


def test_each_value_is_a_variant_whose_name_says_it(catalog: Catalog) -> None:
    workflow = load(catalog)
    assert values(workflow) == {
        "tolerance_m-0_02": 0.02,
        "tolerance_m-0_05": 0.05,
        "tolerance_m-0_1": 0.1,
    }
    assert {one.params_set["cell_m"] for one in workflow.steps["plane"].variants} == {0.01}


def test_a_sweep_is_a_comparison_of_all_its_values(catalog: Catalog) -> None:
    workflow = load(catalog)
    assert workflow.baseline == {"plane": "tolerance_m-0_02"}
    addresses = [cell.address for cell in expand_cells(workflow, catalog)]
    assert [address for address in addresses if address.startswith("wall")] == [
        f"wall@plane=tolerance_m-{value}" for value in ("0_02", "0_05", "0_1")
    ]
    named = load(catalog, f"{ROOM}compare: {{baseline: {{plane: tolerance_m-0_05}}}}\n")
    assert named.baseline == {"plane": "tolerance_m-0_05"}


TWO = (
    ROOM[: ROOM.index("    use: plane.hough2d")]
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
    one = load(catalog, TWO, sets=["plane.hough2d.tolerance_m=0.03"])
    assert one.baseline == {"plane": "hough2d"}
    assert one.compare is not None
    assert one.compare.exclude == ({"plane": "ransac-tolerance_m-0_02"},)
    # What was to be left out of a sweep is no reason to leave out its only value.
    other = load(catalog, TWO, sets=["plane.ransac.tolerance_m=0.03"])
    assert other.compare is not None
    assert other.compare.exclude == ()
    assert other.baseline == {"plane": "hough2d-tolerance_m-0_05"}
    alone = f"{ROOM}compare: {{baseline: {{plane: tolerance_m-0_05}}}}\n"
    assert load(catalog, alone, sets=["plane.tolerance_m=0.03"]).baseline == {}
    with pytest.raises(InvalidWorkflowError, match="has no variant ransac-tolerance_m-0_07"):
        load(catalog, TWO.replace("hough2d-tolerance_m-0_05}", "ransac-tolerance_m-0_07}"))


def test_several_sweeps_make_all_combinations_and_a_variant_stands_in_front(
    catalog: Catalog,
) -> None:
    text = (
        ROOM[: ROOM.index("    use: plane.hough2d")]
        + """\
    in: {cloud: room.cloud}
    variants:
      ransac: {use: plane.ransac}
      fine:
        use: plane.hough2d
        params: {cell_m: {sweep: [0.01, 0.02]}, tolerance_m: {sweep: [0.05, 1]}}
"""
    )
    names = list(values(load(catalog, text)))
    assert names == [
        "ransac",
        "fine-cell_m-0_01-toleranc-0_05",
        "fine-cell_m-0_01-toleranc-1",
        "fine-cell_m-0_02-toleranc-0_05",
        "fine-cell_m-0_02-toleranc-1",
    ]


def test_a_swept_variant_is_still_known_by_its_own_name(catalog: Catalog) -> None:
    text = (
        ROOM[: ROOM.index("    use: plane.hough2d")]
        + """\
    in: {cloud: room.cloud}
    variants:
      ransac: {use: plane.ransac}
      fine: {use: plane.hough2d, params: {tolerance_m: {sweep: [0.05, 0.1]}}}
"""
    )
    workflow = load(catalog, f"{text}compare: {{baseline: {{plane: fine}}}}\n")
    assert workflow.baseline == {"plane": "fine-tolerance_m-0_05"}
    without = load(catalog, f"{text}compare: {{exclude: [{{plane: fine}}]}}\n")
    cells = [cell for cell in expand_cells(without, catalog) if cell.step == "plane"]
    assert [cell.assignment["plane"] for cell in cells] == ["ransac"]


def test_repeats_belong_to_every_value(catalog: Catalog) -> None:
    workflow = load(catalog, ROOM.replace("    in: {cloud", "    repeat: 2\n    in: {cloud"))
    cells = [cell for cell in expand_cells(workflow, catalog) if cell.step == "plane"]
    assert [(cell.params["tolerance_m"], cell.repeat) for cell in cells] == [
        (value, repeat) for value in (0.02, 0.05, 0.1) for repeat in (0, 1)
    ]


def test_a_value_takes_the_place_of_a_sweep_and_a_sweep_that_of_a_value(catalog: Catalog) -> None:
    plain = load(catalog, sets=["plane.tolerance_m=0.03"])
    assert values(plain) == {"": 0.03}
    assert plain.compare is None
    other = load(catalog, sets=["plane.tolerance_m=0.03", "plane.cell_m={sweep: [0.001, 0.002]}"])
    assert values(other, "cell_m") == {"cell_m-0_001": 0.001, "cell_m-0_002": 0.002}
    again = load(catalog, sets=["plane.hough2d.tolerance_m.sweep=[0.5, 0.6]"])
    assert list(values(again).values()) == [0.5, 0.6]
    beside = load(catalog, sets=["plane.cell_m=0.005"])
    assert set(values(beside, "cell_m").values()) == {0.005}
    assert len(beside.steps["plane"].variants) == 3


def test_a_record_holds_the_variants_that_a_sweep_became(catalog: Catalog) -> None:
    workflow = load(catalog)
    again = workflow_from_resolved(resolved_json(workflow), workflow.source)
    assert values(again) == values(workflow)
    assert again.baseline == workflow.baseline


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("{sweep: [0.02]}", "plane.params.tolerance_m.sweep: expected 2 to 100 values, got 1"),
        ("{sweep: 0.02}", "expected a list of at least two values, got 0.02"),
        ("{sweep: [0.02, wide]}", "tolerance_m.sweep[1]: input should be a valid number, got the"),
        ("{sweep: [0.02, 0.05], step: 1}", "unknown key step"),
        ("{sweep: [1, 0.02, 1.0]}", "tolerance_m.sweep[2]: 1.0 is swept twice; leave one of them"),
        ("[0.02, 0.05]", "number, got a list; to try each: {sweep: [0.02, 0.05]}"),
        ("{sweep: [0.02, 0.001]}", "cell_m 0.01 must not exceed tolerance_m"),
    ],
)
def test_what_is_wrong_with_a_sweep_is_told_once_at_its_place(
    catalog: Catalog, written: str, said: str
) -> None:
    with pytest.raises(InvalidWorkflowError) as caught:
        load(catalog, ROOM.replace("{sweep: [0.02, 0.05, 0.1]}", written))
    [problem] = caught.value.problems
    assert said in str(problem)
    assert problem.line == 11


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("plane.tolerance_m={sweep: [1]}", "with 2 to 100 values and nothing beside it"),
        ("plane.tolerance_m={sweep: [1, 2], to: 3}", "nothing beside it"),
        ("plane.tolerance_m={sweep: [1, 2, 1]}", "1 is swept twice"),
        ("plane.tolerance_m=[1, 2]", r"to try each: {sweep: \[1, 2\]}"),
        ("cloud.up={sweep: [x, z]}", "sources take no variants, so nothing of it can be swept"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused_on_the_command_line(
    catalog: Catalog, text: str, said: str
) -> None:
    with pytest.raises((InvalidArgumentsError, InvalidWorkflowError), match=said):
        load(catalog, sets=[text])


def test_a_dataset_cannot_set_what_is_swept(catalog: Catalog) -> None:
    text = f"{ROOM}datasets: {{a: {{set: {{plane.tolerance_m: 0.5}}}}}}\n"
    with pytest.raises(InvalidWorkflowError, match="tolerance_m is swept in step plane"):
        load(catalog, text)


@pytest.mark.parametrize(
    ("variant", "step"),
    [
        (
            "hough2d",
            "{variants: {hough2d: {use: plane.hough2d, %s}, ransac: {use: plane.ransac}}, %s}",
        ),
        ("hough2d", "{use: plane.hough2d, %s, %s}"),
    ],
    ids=["of several", "alone"],
)
def test_a_dataset_names_a_swept_variant_as_set_does(
    catalog: Catalog, variant: str, step: str
) -> None:
    swept = step % ("params: {tolerance_m: {sweep: [0.02, 0.05]}}", "in: {cloud: room.cloud}")
    text = f"orthoflow: 1\nname: swept\nsteps: {{room: {{use: simulate.room}}, plane: {swept}}}\n"
    given = f"{text}datasets: {{a: {{set: {{plane.{variant}.cell_m: 0.005}}}}}}\n"
    calls = load(catalog, given).datasets["a"].calls
    assert [call.params["cell_m"] for call in calls.values()] == [0.005, 0.005]
    refused = f"{text}datasets: {{a: {{set: {{plane.{variant}.tolerance_m: 0.5}}}}}}\n"
    with pytest.raises(InvalidWorkflowError, match="tolerance_m is swept in step plane"):
        load(catalog, refused)


def test_over_datasets_every_value_runs_on_each(catalog: Catalog) -> None:
    text = f"{ROOM}datasets: {{a: {{set: {{plane.cell_m: 0.005}}}}, b: {{}}}}\n"
    cells = [cell for cell in expand_cells(load(catalog, text), catalog) if cell.step == "plane"]
    found = {
        (cell.assignment["data"], cell.params["tolerance_m"], cell.params["cell_m"])
        for cell in cells
    }
    assert found == {
        (data, value, cell_m)
        for data, cell_m in (("a", 0.005), ("b", 0.01))
        for value in (0.02, 0.05, 0.1)
    }


def test_names_stay_short_enough_and_apart(catalog: Catalog) -> None:
    close = "{sweep: [0.123456781, 0.123456782, 123456789012]}"
    names = list(values(load(catalog, ROOM.replace("{sweep: [0.02, 0.05, 0.1]}", close))))
    assert names[:2] == ["tolerance_m-0_123457", "tolerance_m-0_123457-2"]
    assert all(len(name) <= 32 for name in names)


def test_editors_are_told_that_a_value_may_be_a_sweep(catalog: Catalog) -> None:
    import jsonschema

    schema = workflow_schema(catalog)
    document = {
        "orthoflow": 1,
        "steps": {
            "plane": {
                "use": "plane.hough2d",
                "in": {"cloud": "room.cloud"},
                "params": {"tolerance_m": {"sweep": [0.02, 0.05]}},
            }
        },
    }
    jsonschema.validate(document, schema)
    document["steps"]["plane"]["params"] = {"tolerance_m": {"sweep": []}}  # type: ignore[index]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


# --- files of parameters ---


def test_a_file_of_parameters_is_gone_before_by_what_is_set(
    catalog: Catalog, tmp_path: Path
) -> None:
    (tmp_path / "fine.yaml").write_text("plane.cell_m: 0.004\nwall.gsd_m: 0.002\n")
    (tmp_path / "finer.yaml").write_text(
        "plane.cell_m: 0.003\nplane.tolerance_m: {sweep: [1, 2]}\n"
    )
    workflow = load(catalog, set_files=["fine.yaml", "finer.yaml"], sets=["wall.gsd_m=0.001"])
    assert set(values(workflow, "cell_m").values()) == {0.003}
    assert list(values(workflow).values()) == [1, 2]
    assert workflow.steps["wall"].variant("").params["gsd_m"] == 0.001
    # The record says what the files said, not where they lie.
    assert json.loads(resolved_json(workflow))["overrides"] == [
        "--set plane.cell_m=0.004",
        "--set wall.gsd_m=0.002",
        "--set plane.cell_m=0.003",
        '--set plane.tolerance_m={"sweep": [1, 2]}',
        "--set wall.gsd_m=0.001",
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("plane.celm: 1\n", "fine.yaml:1:1: plane.celm: there is no parameter celm"),
        ("wall.gsd_m: fine\n", "fine.yaml:1:13: wall.gsd_m: input should be a valid number"),
        ("wall: {gsd_m: 1}\n", "fine.yaml:1:1: wall: expected step.parameter"),
        ("- 1\n", "fine.yaml:1:1: .*expected a mapping, got a list"),
        ("wall.gsd_m: [1\n", "fine.yaml:1:13: this is not YAML: the bracket"),
    ],
)
def test_mistakes_in_a_file_of_parameters_are_told_at_their_place(
    catalog: Catalog, tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "fine.yaml").write_text(text)
    with pytest.raises(InvalidWorkflowError, match=said):
        load(catalog, set_files=["fine.yaml"])


def test_a_missing_file_of_parameters_is_an_argument_that_is_wrong(catalog: Catalog) -> None:
    with pytest.raises(InvalidArgumentsError, match=r"--set-file nix\.yaml: nix\.yaml cannot"):
        load(catalog, set_files=["nix.yaml"])


# --- names ---


@pytest.mark.parametrize(
    ("value", "word"),
    [
        *((True, "true"), (False, "false"), (None, "none"), (0.02, "0_02"), (7, "7")),
        *((-1.5, "m1_5"), (1.5e-7, "1_5em07"), (2e21, "2e21")),
        *(("Fast Mode!", "fast_mode"), ("", "empty"), ("-_-", "empty"), ("x" * 13, "x" * 12)),
        *(([1, "a b"], "1-a_b"), ({"k": 0.5, "l": True}, "0_5-true")),
    ],
)
def test_a_value_is_a_word_of_small_letters(value: object, word: str) -> None:
    assert sweeps._word(value) == word  # type: ignore[arg-type]


@pytest.mark.parametrize("before", ["", "fine"])
@pytest.mark.parametrize(
    "words",
    [
        {"tolerance_m": ["0_02", "0_1"]},
        {"sigma_corner_max_cells": ["100", "7"], "sigma_wall_max_cells": ["5"]},
        {"A_LONG_PARAMETER_OF_A_METHOD": ["x" * 12], "another": ["1"], "third_one": ["2", "33"]},
    ],
    ids=["one", "two", "three"],
)
def test_names_of_variants_take_as_many_letters_as_there_are(
    before: str, words: dict[str, list[str]]
) -> None:
    short = sweeps._shortened(before, words)
    assert all(name.lower().startswith(short[name]) for name in words)
    parts = [f"{short[name]}-{max(said, key=len)}" for name, said in words.items()]
    longest = "-".join([before, *parts] if before else parts)
    assert len(longest) <= 32
    if any(short[name] != name.lower() for name in words):
        # A letter more for each, and one of `_` that may have been cut off.
        assert len(longest) + 2 * len(words) > 32


@pytest.mark.parametrize(
    ("n_values", "is_sweep"), [(1, False), (2, True), (100, True), (101, False)]
)
def test_a_sweep_has_two_to_a_hundred_values(n_values: int, *, is_sweep: bool) -> None:
    values = list(range(n_values))
    if is_sweep:
        assert sweeps._listed({"sweep": values}) == values
        with pytest.raises(ArgumentError, match="nothing beside it"):
            sweeps._listed({"sweep": values, "more": 1})
    else:
        with pytest.raises(ArgumentError, match="with 2 to 100 values"):
            sweeps._listed({"sweep": values})  # type: ignore[arg-type]
    with pytest.raises(ArgumentError):
        sweeps._listed({"sweep": "0.1"})
