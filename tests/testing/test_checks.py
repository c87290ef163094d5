"""What each rule lets pass and what it refuses, told from what a method is said to have given."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from orthoflow.engine.store import digest_of
from orthoflow.products import (
    Planes,
    PointCloud,
    PointLabels,
    Product,
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


def subject(method: type[Method] = Finding, **witness: object) -> Any:
    return SimpleNamespace(method=method, witness=SimpleNamespace(**witness))


def test_outputs_are_those_that_were_declared() -> None:
    cloud, planes = example_room(n_points=1000)
    labels = PointLabels(plane_index=np.zeros(3, dtype=np.int16))

    def check(*metrics: object, **outputs: Product) -> None:
        digests = {name: digest_of(product) for name, product in outputs.items()}
        run = SimpleNamespace(outputs=outputs, digests=digests, metrics=metrics)
        checks.outputs_are_valid(subject(first=SimpleNamespace(run=run)))

    check(Metric(name="n_planes", value=6.0, unit="1"), planes=planes)
    check(planes=planes, labels=labels)
    with pytest.raises(AssertionError, match="output planes is missing"):
        check(labels=labels)
    with pytest.raises(AssertionError, match="output planes is a cloud, declared is planes"):
        check(planes=cloud)
    with pytest.raises(AssertionError, match="metric n_planes has no unit"):
        check(SimpleNamespace(name="n_planes", unit=""), planes=planes)
    with pytest.raises(AssertionError, match="metric n_walls is none of those that the method"):
        check(Metric(name="n_walls", value=4.0, unit="1"), planes=planes)


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


BESIDE = "the publisher of marks wrote beside its folder: "


@pytest.mark.parametrize(
    ("publisher", "said"),
    [
        (None, ""),
        (publish_well, ""),
        (publish_nothing_but_an_error, r"publisher of marks raised ValueError: disk .*\(test_ch"),
        (lambda _, folder, text: (folder.parent / "a.json").write_text(text), f"{BESIDE}a.json"),
        (
            lambda _, folder, __: (folder / "marks.json").symlink_to("/etc/passwd"),
            "a marks publishes 'marks.json', which is a link or a device",
        ),
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
