"""What an author of methods needs: base classes, the step's context, hooks and specs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl

if TYPE_CHECKING:
    from orthoflow.sdk.context import Metric, StepContext, StepEvent
    from orthoflow.sdk.methods import (
        Determinism,
        Method,
        MethodParams,
        MetricLabel,
        Part,
        Ports,
        PortSpec,
        port_specs,
    )

__all__ = [
    "Determinism",
    "KindSpec",
    "Method",
    "MethodParams",
    "MethodSpec",
    "Metric",
    "MetricLabel",
    "Part",
    "PortSpec",
    "Ports",
    "ProductSpec",
    "StepContext",
    "StepEvent",
    "hookimpl",
    "port_specs",
]

# The hooks must load without numpy and pydantic, so that `plugins list` stays instant; these
# names are looked up only when a method module asks for them.
_HOMES = {
    "Determinism": "methods",
    "Method": "methods",
    "MethodParams": "methods",
    "MetricLabel": "methods",
    "Part": "methods",
    "PortSpec": "methods",
    "Ports": "methods",
    "port_specs": "methods",
    "Metric": "context",
    "StepContext": "context",
    "StepEvent": "context",
}


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"orthoflow.sdk.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'orthoflow.sdk' has no attribute {name!r}")
