"""Ports of a new method as Python classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthoflow import products
from orthoflow.catalog.catalog import Catalog
from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.errors import PluginError
from orthoflow.sdk import port_specs
from orthoflow.sdk.hooks import FILES
from orthoflow.version import DISTRIBUTION


@dataclass(frozen=True)
class Port:
    """A port of the new method.

    Attributes:
        name: name of the port.
        class_name: product class.
        same_as: for an output, the name of an input of the same type, which can be returned
            unchanged.
    """

    name: str
    class_name: str
    same_as: str = ""


@dataclass(frozen=True, kw_only=True)
class KindPorts:
    """Ports of a new method.

    Attributes:
        inputs: input ports in the order of the kind.
        outputs: output ports in the order of the kind.
        imports: names of product classes by module.
        needs: requirements (`name>=version`) for the distributions that provide the kind or a
            product.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    imports: Mapping[str, tuple[str, ...]]
    needs: tuple[str, ...] = ()


def kind_ports(
    catalog: Catalog, kind: str, takes: Sequence[str] = (), gives: Sequence[str] = ()
) -> KindPorts:
    """Return the ports of a new method of a kind.

    Args:
        catalog: the installed plugins.
        kind: a new kind, or an installed one; in this case, the ports are those required by the
            first method of the kind that loads.
        takes: product types of the inputs of a new kind, one port for each.
        gives: existing product types of the outputs of a new kind, one port for each.

    Raises:
        PluginError: the kind cannot be used.
    """
    if kind not in catalog.kinds:
        return _kind_ports(catalog, {one: one for one in takes}, {one: one for one in gives}, [])
    entry = catalog.kinds[kind]
    if entry.state != "fine":
        raise PluginError(entry.problem)
    taken, given = entry.spec.inputs, entry.spec.outputs
    for other in catalog.methods.values():
        if other.spec.kind == kind:
            try:
                method = other.load()
            except PluginError:
                continue
            ports = port_specs(method.In).values()
            required = {port.name: port.type_name for port in ports if port.required}
            if entry.spec.is_source:
                outputs = port_specs(method.Out).values()
                taken, given = required, {port.name: port.type_name for port in outputs}
            elif required:
                taken = {name: type_name for name, type_name in taken.items() if name in required}
            break
    return _kind_ports(catalog, taken, given, [entry.distribution])


def _kind_ports(
    catalog: Catalog,
    taken: Mapping[str, str],
    given: Mapping[str, str],
    besides: Sequence[DistributionInfo],
) -> KindPorts:
    types = dict.fromkeys((*taken.values(), *given.values()))
    classes = {type_name: _class_of(catalog, type_name) for type_name in types}
    imports: dict[str, set[str]] = {}
    for module, name in classes.values():
        imports.setdefault(module, set()).add(name)
    handed_on = {type_name: name for name, type_name in taken.items()}
    of_types = [catalog.products[name].distribution for name in types if name != FILES]
    # A version after `>=` must not contain a local part.
    needs = {
        f"{one.name}>={one.version.partition('+')[0]}"
        for one in (*of_types, *besides)
        if one.name != DISTRIBUTION
    }
    return KindPorts(
        inputs=tuple(Port(name, classes[type_name][1]) for name, type_name in taken.items()),
        outputs=tuple(
            Port(name, classes[type_name][1], same_as=handed_on.get(type_name, ""))
            for name, type_name in given.items()
        ),
        imports={module: tuple(sorted(names)) for module, names in sorted(imports.items())},
        needs=tuple(sorted(needs)),
    )


def _class_of(catalog: Catalog, type_name: str) -> tuple[str, str]:
    if type_name == FILES:
        return products.__name__, products.InputFiles.__name__
    module, _, name = catalog.products[type_name].spec.target.partition(":")
    return (products.__name__, name) if name in products.__all__ else (module, name)
