"""The SDK: ports from annotations, what the context collects and refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orthoflow.errors import CancelledStepError, PluginError, ProductError
from orthoflow.products import Planes, PointCloud
from orthoflow.sdk import (
    Method,
    Metric,
    MetricSpec,
    Ports,
    StepContext,
    StepEvent,
    port_specs,
)
from orthoflow.sdk.methods import labelled


class Inputs(Ports):
    cloud: PointCloud
    planes: Planes | None = None


class Wrong(Ports):
    cloud: int


def context(folder: Path, **more: object) -> StepContext:
    return StepContext(rng=np.random.default_rng(1), cores=1, scratch=folder, **more)


def test_ports_are_read_from_annotations() -> None:
    ports = port_specs(Inputs)
    assert {name: (port.type_name, port.required) for name, port in ports.items()} == {
        "cloud": ("cloud", True),
        "planes": ("planes", False),
    }


def test_a_port_that_carries_no_product_is_refused() -> None:
    with pytest.raises(PluginError, match=r"Wrong.cloud must be annotated with a product class"):
        port_specs(Wrong)


def test_ports_are_frozen_and_take_keywords_only() -> None:
    with pytest.raises(TypeError):
        Inputs(None)  # type: ignore[misc, arg-type]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_metric_that_is_not_finite_is_refused(tmp_path: Path, value: float) -> None:
    with pytest.raises(ProductError, match=r"must be finite, got .*: leave it out instead"):
        context(tmp_path).metric("rms_mm", value, "mm")


def test_a_metric_reported_twice_is_refused(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.metric("rms_mm", 1.0, "mm")
    with pytest.raises(ProductError, match="reported twice"):
        ctx.metric("rms_mm", 2.0, "mm")


def test_progress_never_goes_back(tmp_path: Path) -> None:
    heard: list[StepEvent] = []
    ctx = context(tmp_path, listen=heard.append)
    for fraction in (0.5, 0.2, 7.0):
        ctx.progress(fraction)
    assert [event.fraction for event in heard] == [0.5, 0.5, 1.0]


def test_progress_stops_a_cancelled_step(tmp_path: Path) -> None:
    with pytest.raises(CancelledStepError):
        context(tmp_path, is_cancelled=lambda: True).progress(0.1)


def test_allocated_arrays_lie_in_the_scratch_folder(tmp_path: Path) -> None:
    array = context(tmp_path).allocate("cloud", "x", (1000,), np.float32)
    array[:] = 7
    assert array.dtype == np.float32
    assert next((tmp_path / "allocated").iterdir()).stat().st_size == 4000


class Damp(Method):
    metrics = (
        MetricSpec("n_*", label="damp patches"),
        MetricSpec("damp_share", label="share that is damp", better="lower"),
        MetricSpec("wall_[0-9]*_rms_mm", label="RMS, wall {0}{1}"),
        "other",
    )


def test_metrics_carry_what_their_method_calls_them() -> None:
    reported = [
        Metric(name=name, value=1.0, unit="1")
        for name in ("n_patches", "damp_share", "wall_12_rms_mm", "other")
    ]
    assert [(one.name, one.label, one.better) for one in labelled(Damp, reported)] == [
        ("n_patches", "damp patches", ""),
        ("damp_share", "share that is damp", "lower"),
        ("wall_12_rms_mm", "RMS, wall 12", ""),
        ("other", "", ""),
    ]


def test_the_unit_of_a_metric_is_declared_or_the_end_of_its_name() -> None:
    assert [MetricSpec(name).unit for name in ("rms_mm", "n_points", "damp_share")] == [
        *("mm", "1", "1"),
    ]
    assert MetricSpec("speed", unit="m/s").unit == "m/s"


@pytest.mark.parametrize(
    ("declared", "named"),
    [
        ({"name": "a/b"}, "printable lines of at most 200 bytes"),
        ({"name": "a", "label": "two\nlines"}, "printable lines"),
        ({"name": "a", "better": "most"}, "better must be lower, higher, one or empty, got 'most'"),
    ],
)
def test_a_metric_that_cannot_be_shown_is_refused(declared: dict[str, str], named: str) -> None:
    with pytest.raises(PluginError, match=named):
        MetricSpec(**declared)  # type: ignore[arg-type]
