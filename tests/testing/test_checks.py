"""What each rule lets pass and what it refuses, told from what a method is said to have given."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.errors import OrthoflowError
from orthoflow.products import (
    Camera,
    Cameras,
    Planes,
    PointCloud,
    PointLabels,
    Product,
    Ties,
)
from orthoflow.sdk import Method, Metric, Ports, StepContext
from orthoflow.testing import checks
from orthoflow.testing.examples import example_room


class Finding(Method):
    """Declares what it would give; nothing runs it."""

    id = "plane.finding"
    metrics = ("n_planes",)

    class In(Ports):
        """A cloud."""

        cloud: PointCloud

    class Out(Ports):
        """Planes, and labels where there is time."""

        planes: Planes
        labels: PointLabels | None = None

    def run(self, inputs: Any, params: Any, ctx: StepContext) -> Any:
        """Give nothing."""


class Guessing(Finding):
    """The same, but of results that need not repeat."""

    id = "plane.guessing"
    determinism = "loose"


class Posing(Finding):
    """Orients photos from ties."""

    id = "orient.posing"

    class In(Ports):
        """Ties."""

        ties: Ties

    class Out(Ports):
        """Cameras."""

        cameras: Cameras


def subject(method: type[Method] = Finding, **witness: object) -> Any:
    return SimpleNamespace(method=method, witness=SimpleNamespace(**witness))


def passes(check: Callable[[Any], None], of: Any) -> bool:
    try:
        check(of)
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize(
    ("fractions", "fits"),
    [
        ((), True),
        ((0.0, 0.5, 0.5, 1.0), True),
        ((0.5, 0.4), False),
        ((1.1,), False),
        ((-0.1,), False),
        ((float("nan"),), False),
    ],
)
def test_progress_goes_from_nought_to_one(fractions: tuple[float, ...], fits: bool) -> None:
    ran = subject(first=SimpleNamespace(run=SimpleNamespace(fractions=fractions)))
    assert passes(checks.progress_never_goes_back, ran) is fits


def given_out(outputs: dict[str, Product], *metrics: object) -> Any:
    from orthoflow.engine.store import digest_of

    run = SimpleNamespace(
        outputs=outputs,
        digests={name: digest_of(product) for name, product in outputs.items()},
        metrics=metrics,
    )
    return subject(first=SimpleNamespace(run=run))


def test_outputs_are_those_that_were_declared() -> None:
    cloud, planes = example_room(n_points=1000)
    labels = PointLabels(plane_index=np.zeros(3, dtype=np.int16))
    counted = Metric(name="n_planes", value=6.0, unit="1")
    checks.outputs_are_valid(given_out({"planes": planes}, counted))
    checks.outputs_are_valid(given_out({"planes": planes, "labels": labels}))
    with pytest.raises(AssertionError, match="output planes is missing"):
        checks.outputs_are_valid(given_out({"labels": labels}))
    with pytest.raises(AssertionError, match="output planes is a cloud, declared is planes"):
        checks.outputs_are_valid(given_out({"planes": cloud}))
    nameless = SimpleNamespace(name="n_planes", unit="")
    with pytest.raises(AssertionError, match="metric n_planes has no unit"):
        checks.outputs_are_valid(given_out({"planes": planes}, nameless))
    other = Metric(name="n_walls", value=4.0, unit="1")
    with pytest.raises(AssertionError, match="metric n_walls is none of those that the method"):
        checks.outputs_are_valid(given_out({"planes": planes}, other))


def test_an_output_that_is_another_one_when_stored_is_told() -> None:
    _, planes = example_room(n_points=1000)
    ran = given_out({"planes": planes})
    ran.witness.first.run.digests["planes"] = "sha256:0"
    with pytest.raises(AssertionError, match="output planes changes when stored"):
        checks.outputs_are_valid(ran)


def without_ties(outcome: Callable[[Ties], object]) -> Any:
    return SimpleNamespace(method=Posing, run_on=lambda _name, ties: outcome(ties))


def test_without_ties_no_photo_is_oriented() -> None:
    asked: list[Ties] = []

    def refuses(ties: Ties) -> object:
        asked.append(ties)
        raise OrthoflowError("no ties")

    checks.missing_ties_are_reported(without_ties(refuses))
    # All columns are as empty as each other.
    columns = [getattr(asked[0], field.name) for field in fields(Ties)]
    assert {len(column) for column in columns if isinstance(column, np.ndarray)} == {0}
    found = Cameras(
        cameras=(Camera(photo="a.png", status="no ties"), Camera(photo="b.png", status="ok"))
    )
    run = SimpleNamespace(outputs={"cameras": found})
    with pytest.raises(AssertionError, match=r"without any ties b\.png was oriented all the same"):
        checks.missing_ties_are_reported(without_ties(lambda _: run))
    lost = SimpleNamespace(outputs={"cameras": Cameras(cameras=found.cameras[:1])})
    checks.missing_ties_are_reported(without_ties(lambda _: lost))


def test_refusing_without_a_word_is_no_refusal() -> None:
    def refuse(with_words: str) -> Any:
        ran = subject(trial=SimpleNamespace(inputs={}))

        def run_on(name: str, cloud: PointCloud) -> None:
            assert np.isnan(cloud.y).sum() == 1
            assert np.isnan(cloud.y[100])
            raise OrthoflowError(with_words)

        ran.run_on = run_on
        return ran

    checks.nan_is_refused(refuse("NaN coordinates"))
    with pytest.raises(AssertionError, match="NaN coordinates is refused without a word"):
        checks.nan_is_refused(refuse(" "))


@pytest.mark.parametrize(
    ("name", "methods"),
    [
        ("results-repeat", {Finding, Guessing, Posing}),
        ("threads-do-not-show", {Finding, Posing}),
        ("empty-cloud-is-refused", {Finding, Guessing}),
        ("missing-ties-are-reported", {Posing}),
        ("planes-follow-a-rigid-motion", {Finding, Guessing}),
        ("poses-are-recovered", {Posing}),
        ("cells-show-their-own-place", set()),
        ("mosaics-show-cells-in-place", set()),
    ],
)
def test_a_rule_is_about_the_methods_that_it_names(name: str, methods: set[type[Method]]) -> None:
    (check,) = (check for check in checks.CHECKS if check.name == name)
    assert {method for method in (Finding, Guessing, Posing) if check.applies(method)} == methods


@dataclass(frozen=True, kw_only=True)
class Marks(Product):
    """A stranger's product."""

    type_name = "marks"
    width_m: float


class Marking(Finding):
    """A method that gives it."""

    id = "mark.marking"

    class Out(Ports):
        """Marks."""

        marks: Marks


def publish_well(product: Product, folder: Path, digest: str) -> None:
    (folder / "inner").mkdir()
    (folder / "inner" / "marks.json").write_text(digest)


def publish_nothing_but_an_error(product: Product, folder: Path, digest: str) -> None:
    raise ValueError("disk on fire")


def publish_above(product: Product, folder: Path, digest: str) -> None:
    (folder.parent / "marks.json").write_text(digest)


def publish_here(product: Product, folder: Path, digest: str) -> None:
    Path("marks.json").write_text(digest)


def publish_a_link(product: Product, folder: Path, digest: str) -> None:
    (folder / "marks.json").symlink_to("/etc/passwd")


@pytest.mark.parametrize(
    ("publisher", "said"),
    [
        (None, ""),
        (publish_well, ""),
        (publish_nothing_but_an_error, r"publisher of marks raised ValueError: disk .*\(test_ch"),
        (publish_above, "the publisher of marks wrote beside its folder: marks.json"),
        (publish_here, "the publisher of marks wrote beside its folder: marks.json"),
        (publish_a_link, "a marks publishes 'marks.json', which is a link or a device"),
    ],
)
def test_publishers_write_into_their_folder_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, publisher: object, said: str
) -> None:
    catalog = SimpleNamespace(publisher=lambda _type_name: publisher)
    monkeypatch.setattr(checks, "discover_catalog", lambda: catalog)
    run = SimpleNamespace(outputs={"marks": Marks(width_m=0.1)})
    tried = subject(Marking, first=SimpleNamespace(run=run))
    tried.folder = tmp_path
    (check,) = (
        one for one in checks.CHECKS if one.run is checks.publishers_write_into_their_folder
    )
    assert check.applies(Marking)
    assert not check.applies(Finding)
    with pytest.raises(AssertionError, match=said) if said else contextlib.nullcontext():
        check.run(tried)
