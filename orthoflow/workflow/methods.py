"""Methods as a workflow sees them: their ports and parameters, loaded once each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from orthoflow.catalog.catalog import Catalog
from orthoflow.sdk.methods import Method, PortSpec, port_specs


@dataclass(frozen=True, kw_only=True)
class MethodInfo:
    """A loaded method.

    Attributes:
        id: method id.
        method: its class.
        is_source: it has ports of its own and takes no variants.
        takes: input ports it does not ignore.
        gives: output port -> product type.
    """

    id: str
    method: type[Method]
    is_source: bool
    takes: Mapping[str, PortSpec]
    gives: Mapping[str, str]


def describe_method(catalog: Catalog, method_id: str) -> MethodInfo:
    """Load a method and read its ports.

    Raises:
        WorkflowError: nobody brings a method of that id.
        PluginError: it cannot be loaded.
    """
    entry = catalog.method(method_id)
    method = entry.load()
    return MethodInfo(
        id=method_id,
        method=method,
        is_source=entry.kind is not None and entry.kind.is_source,
        takes=port_specs(method.In),
        gives={port.name: port.type_name for port in port_specs(method.Out).values()},
    )
