"""What an author of methods needs: base classes, the step's context, hooks and specs."""

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

# The hooks must load without numpy and pydantic, so that `plugins list` stays instant; these
# names are looked up only when a method module asks for them.
_HOMES = {
    "Diagnostic": "orthoflow.diagnostics",
    "DiagnosticSpec": "orthoflow.diagnostics",
    "Determinism": "orthoflow.sdk.methods",
    "Method": "orthoflow.sdk.methods",
    "MethodParams": "orthoflow.sdk.methods",
    "MetricSpec": "orthoflow.sdk.methods",
    "PortSpec": "orthoflow.sdk.methods",
    "Ports": "orthoflow.sdk.methods",
    "port_specs": "orthoflow.sdk.methods",
    "Metric": "orthoflow.sdk.context",
    "StepContext": "orthoflow.sdk.context",
    "StepEvent": "orthoflow.sdk.context",
}


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'orthoflow.sdk' has no attribute {name!r}")
