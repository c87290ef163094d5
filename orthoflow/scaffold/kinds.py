"""Ports of a new method as Python classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthoflow import products
from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.errors import PluginError
from orthoflow.sdk import PortSpec, port_specs
from orthoflow.sdk.hooks import FILES
from orthoflow.version import DISTRIBUTION


@dataclass(frozen=True, kw_only=True)
class Port:
    """A port of the new method.

    Attributes:
        name: name of the port.
        class_name: product class.
        required: whether it must be connected.
        same_as: for an output, the required input of the same type that can be returned unchanged.
    """

    name: str
    class_name: str
    required: bool = True
    same_as: str = ""


@dataclass(frozen=True, kw_only=True)
class KindPorts:
    """Ports of a new method.

    Attributes:
        inputs: input ports in the order of the kind.
        outputs: output ports in the order of the kind.
        imports: module -> names of product classes.
        needs: requirements for other plugins that provide the kind or a product.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    imports: Mapping[str, tuple[str, ...]]
    needs: tuple[str, ...] = ()


def kind_ports(catalog: Catalog, kind: str) -> KindPorts:
    """Derive the ports of a new method from a kind and its first installed method that loads.

    Raises:
        PluginError: the kind cannot be used.
    """
    entry = catalog.kinds[kind]
    if entry.state != "fine":
        raise PluginError(entry.problem)
    taken: Mapping[str, PortSpec] = {}
    given: Mapping[str, PortSpec] = {}
    for other in catalog.methods.values():
        if other.spec.kind == kind:
            try:
                method = other.load()
            except PluginError:
                continue
            taken, given = port_specs(method.In), port_specs(method.Out)
            break
    if not entry.spec.is_source:
        required = {name: name not in taken or taken[name].required for name in entry.spec.inputs}
        wanted = {name for name in taken if taken[name].required} or set(entry.spec.inputs)
        taken = {
            name: PortSpec(name=name, type_name=type_name, required=required[name])
            for name, type_name in entry.spec.inputs.items()
            if name in wanted
        }
        given = {
            name: PortSpec(name=name, type_name=type_name, required=True)
            for name, type_name in entry.spec.outputs.items()
        }
    return _kind_ports(catalog, taken, given, [entry.distribution])


def new_kind_ports(catalog: Catalog, takes: Sequence[str], gives: Sequence[str]) -> KindPorts:
    """Return the ports for a method of a new kind: one per product type, all required."""
    taken, given = (
        {name: PortSpec(name=name, type_name=name, required=True) for name in names}
        for names in (takes, gives)
    )
    return _kind_ports(catalog, taken, given, [])


def _kind_ports(
    catalog: Catalog,
    taken: Mapping[str, PortSpec],
    given: Mapping[str, PortSpec],
    besides: Sequence[DistributionInfo],
) -> KindPorts:
    """Return the ports of a new method; `besides` are required distributions but for products."""
    types = dict.fromkeys(port.type_name for port in (*taken.values(), *given.values()))
    classes = {type_name: _class_of(catalog, type_name) for type_name in types}
    imports: dict[str, set[str]] = {}
    for module, name in classes.values():
        imports.setdefault(module, set()).add(name)
    handed_on = {port.type_name: port.name for port in taken.values() if port.required}
    of_types = [catalog.products[name].distribution for name in types if name != FILES]
    # A version after `>=` cannot contain a local part.
    needs = {
        f"{one.name}>={one.version.partition('+')[0]}"
        for one in (*of_types, *besides)
        if one.name != DISTRIBUTION
    }
    inputs, outputs = (
        tuple(
            Port(
                name=port.name,
                class_name=classes[port.type_name][1],
                required=port.required,
                same_as=handed_on.get(port.type_name, "") if ports is given else "",
            )
            for port in ports.values()
        )
        for ports in (taken, given)
    )
    return KindPorts(
        inputs=inputs,
        outputs=outputs,
        imports={module: tuple(sorted(names)) for module, names in sorted(imports.items())},
        needs=tuple(sorted(needs)),
    )


def _class_of(catalog: Catalog, type_name: str) -> tuple[str, str]:
    if type_name == FILES:
        return products.__name__, products.InputFiles.__name__
    module, _, name = catalog.products[type_name].spec.target.partition(":")
    return (products.__name__, name) if name in products.__all__ else (module, name)
