"""All metrics of the built-in methods are declared, so that comparisons can be checked.

The conformance suite checks metrics reported on its examples; here, the sources are searched for
all others.
"""

from __future__ import annotations

import re
from pathlib import Path

import orthoflow_plugins
import pytest

from orthoflow.catalog.discovery import discover_catalog
from orthoflow.sdk import Method

_PLUGINS = Path(orthoflow_plugins.__file__).parent
_GIVEN = re.compile(
    r"""ctx\.metric\(\s*f?"([^"]+)"|Finding\(\s*name=f?"([^"]+)"|\bsay\(f?"([^"]+)\""""
)
# Possible values of expressions in braces in the sources.
_PARTS = {"axis": "x", "reach": "1", "unit": "mm", "kind": "iou", "score": "iou"}
# Names composed of parts, whose metrics the conformance suite checks.
_PUT_TOGETHER = {
    *(
        "{prefix}{name}",
        "{name}_s",
        "{name}_cpu_s",
        "{name}_median",
        "{name}_worst",
        "{name}_max_{unit}",
        "{name}_median_{unit}",
    ),
    *("all_{finding.name}", "wall_{finding.wall}_{finding.name}", "worst_{item.name}"),
    *("{name}_share", "{state.name.lower()}_share", "label_{kind}_mean"),
}


def our_methods() -> list[type[Method]]:
    catalog = discover_catalog()
    ours = [
        entry
        for entry in catalog.methods.values()
        if entry.spec.target.startswith("orthoflow_plugins")
    ]
    return [entry.load() for entry in ours]


def test_every_method_of_ours_declares_its_metrics_once() -> None:
    methods = our_methods()
    assert len(methods) >= 25
    assert [method.id for method in methods if not method.metrics] == []
    names = {method.id: [spec.name for spec in method.metric_specs()] for method in methods}
    assert {one for one, found in names.items() if len(set(found)) < len(found)} == set()


@pytest.mark.parametrize(
    "kind",
    sorted(path.name for path in _PLUGINS.iterdir() if path.is_dir() and path.name[0] != "_"),
)
def test_every_metric_in_the_sources_of_a_kind_is_declared_by_a_method_there(kind: str) -> None:
    methods = [m for m in our_methods() if m.__module__.startswith(f"orthoflow_plugins.{kind}.")]
    sources = "".join(path.read_text() for path in sorted((_PLUGINS / kind).glob("*.py")))
    names = {next(filter(None, found)) for found in _GIVEN.findall(sources)} - _PUT_TOGETHER
    # Metrics of a single true plane or photo are only in the record.
    names = {name for name in names if "[" not in name}
    whole = {re.sub(r"\{(\w+)\}", lambda part: _PARTS.get(part[1], "x"), name) for name in names}
    unknown = {name for name in whole if not any(method.may_report(name) for method in methods)}
    assert unknown == set()
