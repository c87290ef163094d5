"""Golden results: what moved beyond the tolerances of its type is noticed, on any machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from orthoflow.errors import InputError
from orthoflow.products import Planes, Product
from orthoflow.sdk import Method, MethodParams, Ports
from orthoflow.testing.examples import example_room
from orthoflow.testing.golden import golden_problem, sample_problem
from orthoflow.testing.trials import Trial


class Mine(Method):
    """A method whose results the tests make up."""

    id = "plane.mine"
    Params = MethodParams
    In = Ports
    Out = Ports


def planes(lift_m: float = 0.0) -> Planes:
    _, truth = example_room()
    return replace(truth, offset=truth.offset + lift_m)


def trial(*, input_lift_m: float = 0.0, **params: object) -> Trial:
    return Trial(method=Mine, inputs={"before": planes(input_lift_m)}, params=params)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A golden file with the planes of the room."""
    path = tmp_path / "golden.json"
    assert golden_problem(path, trial(), {"planes": planes()}) == ""
    return path


MOVED = "output planes differs from golden.json (6 of 6 sampled values of offset changed)"


def test_a_result_that_moved_is_noticed_and_not_recorded(file: Path) -> None:
    before = file.read_text()
    assert golden_problem(file, trial(), {"planes": planes(1e-9)}) == ""
    assert golden_problem(file, trial(), {"planes": planes(2e-5)}).startswith(MOVED)
    assert file.read_text() == before


def test_a_raised_version_or_another_tool_records_anew(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mine, "result_version", 2)
    assert golden_problem(file, trial(), {"planes": planes(0.1)}) == ""
    assert golden_problem(file, trial(), {"planes": planes()}).startswith(MOVED)
    monkeypatch.setattr(Mine, "tools", classmethod(lambda cls: {"library": "2.0"}))
    assert golden_problem(file, trial(), {"planes": planes()}) == ""


def test_a_result_of_something_else_records_anew(file: Path) -> None:
    moved = {"planes": planes(0.1)}
    assert golden_problem(file, trial(input_lift_m=1e-9), moved).startswith(MOVED)
    assert golden_problem(file, trial(input_lift_m=1e-9), {"planes": planes(1e-9)}) == ""
    assert golden_problem(file, trial(input_lift_m=0.1), moved) == ""
    assert golden_problem(file, trial(input_lift_m=0.1), {"planes": planes()}).startswith(MOVED)
    assert golden_problem(file, trial(input_lift_m=0.1, cell_m=0.2), {"planes": planes()}) == ""


def stating(*rmse_grey: float, lift_m: float = 0.0) -> Mapping[str, Product]:
    """Planes that say something of themselves, as an inspection does: an RMSE over few cells."""
    return {"planes": replace(planes(lift_m), details={"rmse_grey": list(rmse_grey)})}


def test_what_other_numbers_went_into_is_held_to_its_tolerances_alone(tmp_path: Path) -> None:
    file = tmp_path / "golden.json"
    assert golden_problem(file, trial(), stating(19.55, 4.09, 0.0259)) == ""
    before, elsewhere = file.read_text(), trial(input_lift_m=2e-6)
    assert golden_problem(file, elsewhere, stating(20.23, 4.20, 0.0254)) == ""
    lifted = stating(20.23, 4.20, 0.0254, lift_m=2e-5)
    assert golden_problem(file, elsewhere, lifted).startswith(MOVED)
    one_less = golden_problem(file, elsewhere, stating(20.23, 4.20))
    assert "(only one of the results has metadata [3])" in one_less
    assert file.read_text() == before


def test_an_output_that_appears_and_another_file_are_noticed(file: Path) -> None:
    problem = golden_problem(file, trial(), {"planes": planes(), "walls": planes()})
    assert problem.startswith("output walls differs from golden.json (one of them has")
    file.write_text('{"plane.mine": {"1": {}}}')
    with pytest.raises(InputError, match=r"is not a valid file of golden results .*: remove it"):
        golden_problem(file, trial(), {"planes": planes()})


@pytest.mark.parametrize(("factor", "is_noticed"), [(0.9, False), (1.2, True)])
def test_what_states_no_tolerance_may_differ_by_a_millionth(
    factor: float, is_noticed: bool
) -> None:
    for before, after in ((0.0, factor * 1e-6), (1e3, 1e3 + factor * 1e-3)):
        pair = ({"a [1]": [value]} for value in (before, after))
        assert bool(sample_problem(*pair, {})) is is_noticed


@pytest.mark.parametrize(("n_moved", "is_noticed"), [(2, False), (3, True)])
def test_one_of_sixteen_sampled_values_may_stray(n_moved: int, is_noticed: bool) -> None:
    moved = [1.0] * n_moved + [0.0] * (32 - n_moved)
    pair = ({"a [32]": values} for values in ([0.0] * 32, moved))
    assert bool(sample_problem(*pair, {})) is is_noticed


def test_an_array_that_only_one_of_two_samples_has_is_named() -> None:
    one = [2.0]
    for pair in (({"a": one}, {"a": one, "b": one}), ({"b": one, "a": one}, {"a": one})):
        assert sample_problem(*pair, {}) == "only one of the results has b"
