"""What a method reports, and how that is called."""

from __future__ import annotations

from orthoflow.products import Photos, Planes, PointCloud
from orthoflow.sdk import Method, MethodParams, Metric, MetricSpec, Ports
from orthoflow.sdk.methods import labelled


class Counting(Method):
    """Counts the letters of photos' names."""

    id = "match.counting"
    metrics = (MetricSpec("n_*", label="number of {0}", better="higher"), "rms_px")

    class Params(MethodParams):
        """None."""

    class In(Ports):
        photos: Photos
        planes: Planes | None

    class Out(Ports):
        cloud: PointCloud


def test_metrics_are_those_declared_and_labelled() -> None:
    reported = [Metric(name=name, value=1.0, unit="1") for name in ("n_planes", "rms_px")]
    count, rms = labelled(Counting, reported)
    assert (count.label, count.better) == ("number of planes", "higher")
    assert (rms.label, rms.unit) == ("", "1")
    assert [Counting.may_report(name) for name in ("n_planes", "rms_px", "rms_mm")] == [
        *(True, True, False),
    ]
    anything = type("Anything", (Counting,), {"metrics": ()})
    assert anything.may_report("rms_mm")
    assert Counting.tools() == {}
