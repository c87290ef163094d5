"""The plan says what will run and why; keys hold what decides a result and nothing else."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.engine.keys import CellKey, MethodFacts, cell_key, library_versions, method_facts
from orthoflow.engine.plan import RunOptions, explain
from orthoflow.engine.results import CellResult, ProductRef
from orthoflow.errors import ArgumentError
from orthoflow.workflow.expand import Cell
from tests.engine_world import World

CHAIN = """
steps:
  first: {use: make.range}
  second: {use: work.add, in: {numbers: first.numbers}}
  third: {use: work.add, in: {numbers: second.numbers}, params: {amount: 3.0}}
"""

FROM_FILE = """
inputs: {data: {files: data.txt}}
steps:
  first: {use: make.file, in: {files: inputs.data}}
  second: {use: work.add, in: {numbers: first.numbers}}
"""


def statuses(world: World, steps: str, **options: object) -> dict[str, str]:
    return {address: status for address, (status, _) in world.status(steps, **options).items()}


def run(world: World, steps: str, into: str = "run") -> None:
    assert world.run(steps, into=into, executor="inline").status == "ok"


def write_data(world: World, text: str, name: str = "data.txt") -> Path:
    path = world.folder / name
    path.write_text(text)
    return path


# Keys ---------------------------------------------------------------------------------------------

FACTS = MethodFacts(
    method="work.noise",
    target="x:Y",
    result_version=1,
    determinism="seeded",
    citations=(),
    distribution="toys",
    distribution_version="1",
    tools={"tool": "1"},
    code={"plugin": "aa"},
    inputs={},
    outputs={},
)
CELL = Cell(address="step", step="step", method="work.noise", params={"amount": 1.0}, seed=5)
LEFT = ProductRef(type_name="numbers", encoding_version=1, digest="sha256:" + "1" * 64)
RIGHT = dataclasses.replace(LEFT, digest="sha256:" + "2" * 64)
INPUTS = {"left": LEFT, "right": RIGHT}


def test_an_executor_is_the_one_that_is_asked_for() -> None:
    assert RunOptions(executor="dask", scheduler="tcp://x:1").scheduler == "tcp://x:1"
    with pytest.raises(ArgumentError, match="--scheduler requires --executor dask"):
        RunOptions(scheduler="tcp://x:1")
    with pytest.raises(ArgumentError, match="--executor must be local, inline or dask, got slow"):
        RunOptions(executor="slow")  # type: ignore[arg-type]


def key_of(
    cell: Cell = CELL, facts: MethodFacts = FACTS, inputs: dict[str, ProductRef] | None = None
) -> str:
    return cell_key(cell, facts, INPUTS if inputs is None else inputs).key


OTHER_FACTS = (
    *({"method": "work.add"}, {"result_version": 2}, {"tools": {"tool": "2"}}),
    *({"tools": {"loot": "1"}}, {"code": {"plugin": "ab"}}, {"code": {"framework": "aa"}}),
    *({"code": {}}, {"determinism": "exact"}),
)
OTHER_CELLS = (
    *({"params": {"amount": x}} for x in (1.0000000000000002, 1, True, "1.0", None, -0.0, 0.0)),
    *({"params": {"amounts": 1.0}}, {"params": {}}, {"seed": 6}),
)
OTHER_INPUTS = (
    *({"left": RIGHT, "right": LEFT}, {"left": LEFT, "right": LEFT}, {"left": LEFT}),
    {"left": LEFT, "right": dataclasses.replace(RIGHT, encoding_version=2)},
    {"left": LEFT, "right": dataclasses.replace(RIGHT, type_name="heights")},
)
NAMES_AND_RESOURCES = (
    *({"address": "other@a=b"}, {"step": "other"}, {"repeat": 3}, {"cores": 1}),
    *({"timeout_s": 5.0}, {"assignment": {"step": "x"}}, {"params_set": {"amount": 1.0}}),
)


def test_whatever_decides_a_result_changes_the_key_and_nothing_else_does() -> None:
    keys = [
        key_of(),
        *(key_of(facts=dataclasses.replace(FACTS, **change)) for change in OTHER_FACTS),
        *(key_of(dataclasses.replace(CELL, **change)) for change in OTHER_CELLS),
        *(key_of(inputs=inputs) for inputs in OTHER_INPUTS),
    ]
    assert len(set(keys)) == len(keys)
    for change in NAMES_AND_RESOURCES:
        assert key_of(dataclasses.replace(CELL, **change)) == key_of()
    exact = dataclasses.replace(FACTS, determinism="exact")
    assert key_of(facts=exact) == key_of(dataclasses.replace(CELL, seed=99), facts=exact)


# Reasons ------------------------------------------------------------------------------------------


def result_of(cell: Cell = CELL, **facts: object) -> CellResult:
    made = cell_key(cell, dataclasses.replace(FACTS, **facts), INPUTS)  # type: ignore[arg-type]
    return CellResult(status="ok", method=FACTS.method, key=made.key, key_preimage=made.preimage)


NOW = cell_key(CELL, FACTS, INPUTS)


REASONS = {
    "params.amount: 2.5 -> 1.0": result_of(dataclasses.replace(CELL, params={"amount": 2.5})),
    "params.amount: absent -> 1.0": result_of(dataclasses.replace(CELL, params={})),
    f'params.amount: "{"x" * 36}... -> 1.0': (
        result_of(dataclasses.replace(CELL, params={"amount": "x" * 99}))
    ),
    "result_version 7 -> 1": result_of(result_version=7),
    'tool "0.9" -> "1"': result_of(tools={"tool": "0.9"}),
    "code changed": result_of(code={"plugin": "zz"}),
    "seed 6 -> 5": result_of(dataclasses.replace(CELL, seed=6)),
    "its stored result is incomplete or damaged": result_of(),
}


def test_the_changed_ingredient_is_named() -> None:
    assert {explain(NOW, [earlier]): earlier for earlier in REASONS.values()} == REASONS


def test_an_unreadable_earlier_preimage_does_no_harm() -> None:
    for text in ("", "[]"):
        earlier = dataclasses.replace(result_of(), key="x", key_preimage=text)
        reason = explain(CellKey(key="k", preimage="{}"), [earlier])
        assert reason == "the way its cache key is computed has changed"


# Plans --------------------------------------------------------------------------------------------


def test_a_changed_parameter_reruns_only_what_depends_on_it(world: World) -> None:
    run(world, CHAIN)
    changed = CHAIN.replace("first.numbers}", "first.numbers}, params: {amount: 2.0}")
    assert world.status(changed)["first"][0] == "cached"
    assert world.status(changed)["second"] == ("will run", "params.amount: 1.0 -> 2.0")
    assert world.status(changed)["third"] == ("unknown yet", "needs second, which will run")
    again = world.run(changed, into="again", executor="inline")
    assert set(again.cached) == {"first"}


def test_equal_outputs_cut_off_what_follows(world: World) -> None:
    steps = """
steps:
  first: {use: make.range}
  second: {use: work.add, in: {numbers: first.numbers}, params: {amount: AMOUNT}}
  sign: {use: work.does, in: {numbers: second.numbers}, params: {code: values = np.sign(values)}}
  last: {use: work.add, in: {numbers: sign.numbers}}
"""
    run(world, steps.replace("AMOUNT", "1.0"))
    outcome = world.run(steps.replace("AMOUNT", "2.0"), into="again", executor="inline")
    assert set(outcome.cached) == {"first", "last"}


def test_forced_steps_run_and_equal_results_end_it_there(world: World) -> None:
    run(world, CHAIN)
    status = world.status(CHAIN, force=("second",))
    assert status["second"] == ("will run", "forced")
    assert status["third"] == ("unknown yet", "needs second, which will run")
    status = world.status(CHAIN, force=("first",))
    assert status["second"] == ("unknown yet", "needs first, which will run")
    assert status["third"] == ("unknown yet", "needs second, which is not known yet")
    assert world.status(CHAIN, force=("first", "third"))["third"] == ("will run", "forced")
    outcome = world.run(CHAIN, into="again", executor="inline", force=("second",))
    assert set(outcome.cached) == {"first", "third"}
    assert outcome.results["second"].run_id == outcome.run_id


def test_a_selection_leaves_out_the_rest(world: World) -> None:
    assert list(statuses(world, CHAIN, until=("second",))) == ["first", "second"]
    assert list(statuses(world, CHAIN, only=("first",))) == ["first"]
    assert list(statuses(world, CHAIN, from_=("third",))) == ["first", "second", "third"]


def test_file_content_and_name_count_but_not_its_time(world: World) -> None:
    data = write_data(world, "1 2 3")
    run(world, FROM_FILE)
    os.utime(data, (1, 1))
    assert set(statuses(world, FROM_FILE).values()) == {"cached"}
    write_data(world, "1 2 4")
    assert world.status(FROM_FILE)["first"] == ("will run", "input files changed")
    write_data(world, "1 2 3", "other.txt")
    renamed = FROM_FILE.replace("data.txt", "other.txt")
    assert world.status(renamed)["first"] == ("will run", "input files changed")
    write_data(world, "1 2 3")
    (world.folder / "moved").mkdir()
    (world.folder / "data.txt").rename(world.folder / "moved" / "data.txt")
    moved = FROM_FILE.replace("data.txt", "moved/data.txt")
    assert set(statuses(world, moved).values()) == {"cached"}


def test_a_step_whose_data_are_absent_is_skipped_with_all_behind_it(world: World) -> None:
    steps = FROM_FILE.replace("{files: data.txt}", "{optional: true}")
    assert statuses(world, steps) == {"first": "skipped", "second": "skipped"}
    outcome = world.run(steps, executor="inline")
    assert {r.status for r in outcome.results.values()} == {"skipped"}
    assert outcome.exit_code == 0


# How long it takes --------------------------------------------------------------------------------


def test_of_what_a_method_took_the_nearest_counts(world: World) -> None:
    steps = """
steps:
  first: {use: make.range}
  second: {use: work.slow, in: {numbers: first.numbers}, params: {steps: 1}}
"""
    run(world, steps, into="short")
    run(world, steps.replace("steps: 1", "steps: 8"), into="long")

    def took_s(n_steps: int) -> float:
        plan = world.plan(steps, sets=[f"second.steps={n_steps}"], force=("second",))
        return plan.cells[1].took_s or 0.0

    # Seven steps more, of a twentieth of a second each.
    assert took_s(8) - took_s(1) > 0.3
    assert took_s(1) > 1.0


# Libraries and code in a key ----------------------------------------------------------------------


STEPS = """
steps:
  first: {use: make.range}
  second: {use: work.add, in: {numbers: first.numbers}}
"""


@pytest.fixture(autouse=True)
def _fresh_versions() -> Iterator[None]:
    yield
    library_versions.cache_clear()


def require(world: World, *requirements: str) -> None:
    """Let the toys' distribution require others."""
    lines = "".join(f"Requires-Dist: {text}\n" for text in requirements)
    metadata = world.site / "toy_plugin-1.0.dist-info" / "METADATA"
    metadata.write_text(f"Metadata-Version: 2.1\nName: toy-plugin\nVersion: 1.0\n{lines}")
    library_versions.cache_clear()


def install(world: World, name: str, version: str) -> None:
    """Put an empty library with a module of its name where the toys lie."""
    for old in world.site.glob(f"{name}-*.dist-info"):
        (old / "METADATA").unlink()
        (old / "RECORD").unlink()
        old.rmdir()
    info = world.site / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (info / "RECORD").write_text(f"{name}.py,,\n")
    (world.site / f"{name}.py").touch()
    library_versions.cache_clear()


def test_every_method_of_ours_is_keyed_by_the_libraries_that_compute() -> None:
    catalog = discover_catalog()
    for name in catalog.methods:
        tools = method_facts(name, catalog).tools
        assert tools.keys() >= {"numpy", "numba", "scipy", "opencv-python-headless", "pycolmap"}
        assert tools.keys().isdisjoint({"click", "rich", "h5py"})


@pytest.mark.parametrize("how", ["required", "imported"])
def test_a_new_version_of_a_library_computes_again_and_is_named(world: World, how: str) -> None:
    install(world, "lintel", "1.0")
    if how == "required":
        require(world, "lintel>=0.5; python_version > '3'", "absent", "pytest; extra == 'test'")
    else:
        with (world.site / "toy_plugin" / "works.py").open("a") as source:
            source.write("\n\ndef later() -> None:\n    import lintel\n")
    assert world.run(STEPS, executor="inline").status == "ok"
    assert {status for status, _ in world.status(STEPS).values()} == {"cached"}
    install(world, "lintel", "1.1")
    assert world.status(STEPS)["first"] == ("will run", 'lintel "1.0" -> "1.1"')


def test_a_method_may_declare_that_a_library_does_not_change_its_results(world: World) -> None:
    install(world, "lintel", "1.0")
    require(world, "lintel")
    source = world.site / "toy_plugin" / "makes.py"
    id_line = '    id = "make.range"\n'
    declared = f'{id_line}    unaffected_by = ("Lintel",)\n'
    source.write_text(source.read_text().replace(id_line, declared))
    catalog = world.catalog()
    assert "lintel" not in method_facts("make.range", catalog).tools
    assert "lintel" in method_facts("work.noise", catalog).tools


@pytest.mark.parametrize("name", ["works.py", "table.csv", "inner/table.npy"])
def test_a_plugin_whose_files_changed_under_the_same_version_computes_again(
    world: World, name: str
) -> None:
    file = world.site / "toy_plugin" / name
    file.parent.mkdir(exist_ok=True)
    with file.open("a") as stream:
        stream.write("# one\n")
    assert world.run(STEPS, executor="inline").status == "ok"
    assert world.status(STEPS)["first"][0] == "cached"
    with file.open("a") as stream:
        stream.write("# other\n")
    assert world.status(STEPS)["first"] == ("will run", "code changed")
