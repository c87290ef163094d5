"""Ports of a new method as Python classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orthoflow import products
from orthoflow.catalog.catalog import Catalog, KindEntry
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
    taken, given = {one: one for one in takes}, {one: one for one in gives}
    if kind in catalog.kinds:
        taken, given = _declared_ports(catalog, catalog.kinds[kind])
    types = dict.fromkeys((*taken.values(), *given.values()))
    classes = {type_name: _class_of(catalog, type_name) for type_name in types}
    imports: dict[str, set[str]] = {}
    for module, name in classes.values():
        imports.setdefault(module, set()).add(name)
    handed_on = {type_name: name for name, type_name in taken.items()}
    providers = [catalog.products[name].distribution for name in types if name != FILES]
    providers += [catalog.kinds[kind].distribution] if kind in catalog.kinds else []
    # A version after `>=` must not contain a local part.
    needs = {
        f"{one.name}>={one.version.partition('+')[0]}"
        for one in providers
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


def _declared_ports(catalog: Catalog, kind: KindEntry) -> tuple[dict[str, str], dict[str, str]]:
    """Return the product types of inputs and outputs of an installed kind by port."""
    if kind.state != "fine":
        raise PluginError(kind.problem)
    taken, given = dict(kind.spec.inputs), dict(kind.spec.outputs)
    for other in catalog.methods.values():
        if other.spec.kind == kind.spec.name:
            try:
                method = other.load()
            except PluginError:
                continue
            ports = port_specs(method.In).values()
            required = {port.name: port.type_name for port in ports if port.required}
            if kind.spec.is_source:
                outputs = port_specs(method.Out).values()
                return required, {port.name: port.type_name for port in outputs}
            return {name: taken[name] for name in taken if name in required or not required}, given
    return taken, given


def _class_of(catalog: Catalog, type_name: str) -> tuple[str, str]:
    if type_name == FILES:
        return products.__name__, products.InputFiles.__name__
    module, _, name = catalog.products[type_name].spec.target.partition(":")
    return (products.__name__, name) if name in products.__all__ else (module, name)
