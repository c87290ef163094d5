"""The interface for authors of methods: base classes, step context, hooks and specs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from orthoflow.sdk.hooks import KindSpec, MethodSpec, ProductSpec, hookimpl

if TYPE_CHECKING:
    from orthoflow.diagnostics import Diagnostic, DiagnosticSpec
    from orthoflow.sdk.context import Metric, StepContext, StepEvent
    from orthoflow.sdk.methods import (
        Determinism,
        Method,
        MethodParams,
        MetricSpec,
        Ports,
        PortSpec,
        port_specs,
    )

__all__ = [
    "Determinism",
    "Diagnostic",
    "DiagnosticSpec",
    "KindSpec",
    "Method",
    "MethodParams",
    "MethodSpec",
    "Metric",
    "MetricSpec",
    "PortSpec",
    "Ports",
    "ProductSpec",
    "StepContext",
    "StepEvent",
    "hookimpl",
    "port_specs",
]

# Hooks must be importable without numpy and pydantic, so that `plugins list` is fast; all other
# names are imported on first use.
_HOMES = ("orthoflow.sdk.methods", "orthoflow.sdk.context", "orthoflow.diagnostics")


def __getattr__(name: str) -> object:
    if name in __all__:
        for home in map(import_module, _HOMES):
            if hasattr(home, name):
                return getattr(home, name)
    raise AttributeError(f"module 'orthoflow.sdk' has no attribute {name!r}")
