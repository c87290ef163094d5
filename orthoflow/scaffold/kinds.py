"""Ports of a new method as Python classes, and the installed method that it starts from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from orthoflow import products
from orthoflow.catalog.catalog import Catalog, MethodEntry
from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.errors import ArgumentError, PluginError
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
    """Ports of a new method, and the installed method that it calls at first.

    Attributes:
        inputs: input ports in the order of the kind.
        outputs: output ports in the order of the kind.
        imports: module -> names of product classes.
        needs: requirements for other plugins that provide the kind, the first method or a product.
        start_module: module of the installed method; empty if there is none.
        start_class: class of that method.
        start_id: id of that method.
        start_inputs: input ports that this method uses.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    imports: Mapping[str, tuple[str, ...]]
    needs: tuple[str, ...] = ()
    start_module: str = ""
    start_class: str = ""
    start_id: str = ""
    start_inputs: tuple[str, ...] = ()

    @property
    def hands_on(self) -> bool:
        """Whether each output can be an input returned unchanged."""
        return all(port.same_as for port in self.outputs)


def kind_ports(catalog: Catalog, kind: str) -> KindPorts:
    """Derive the ports of a new method from a kind and its installed methods.

    Raises:
        PluginError: the kind cannot be used.
    """
    entry = catalog.kinds[kind]
    if entry.state != "fine":
        raise PluginError(entry.problem)
    start = loadable_method(catalog, kind)
    taken, given = _declared(start) if start else ({}, {})
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
    besides = [entry.distribution, *([start.distribution] if start else [])]
    return _kind_ports(catalog, taken, given, start, besides)


def loadable_method(catalog: Catalog, kind: str) -> MethodEntry | None:
    """Return the first installed method of a kind whose class can be loaded, or None."""
    for entry in catalog.methods.values():
        if entry.spec.kind == kind:
            try:
                entry.load()
            except PluginError:
                continue
            return entry
    return None


def new_kind_ports(catalog: Catalog, takes: Sequence[str], gives: Sequence[str]) -> KindPorts:
    """Return the ports for a method of a new kind: one per product type, all required.

    Args:
        catalog: the installed plugins.
        takes: product types of the inputs.
        gives: product types of the outputs; types that are not inputs are made from the inputs by
            an installed method.

    Raises:
        ArgumentError: no installed method makes them.
    """
    made = [name for name in gives if name not in takes]
    start = _maker(catalog, takes, made) if made else None
    if made and not start:
        raise ArgumentError(
            f"no installed method makes {' and '.join(made)} of {' and '.join(takes)}, so there is "
            f"nothing to start from: name {' and '.join(made)} with --takes, too"
        )
    taken, given = (
        {name: PortSpec(name=name, type_name=name, required=True) for name in names}
        for names in (takes, gives)
    )
    return _kind_ports(catalog, taken, given, start, [start.distribution] if start else [])


def _kind_ports(
    catalog: Catalog,
    taken: Mapping[str, PortSpec],
    given: Mapping[str, PortSpec],
    start: MethodEntry | None,
    besides: Sequence[DistributionInfo],
) -> KindPorts:
    """Return the ports of a new method.

    Args:
        catalog: the installed plugins.
        taken: input ports by name.
        given: output ports by name.
        start: installed method that the new method calls at first.
        besides: required distributions in addition to those of the product types.
    """
    types = dict.fromkeys(port.type_name for port in (*taken.values(), *given.values()))
    classes = {type_name: _class_of(catalog, type_name) for type_name in types}
    imports: dict[str, set[str]] = {}
    for module, name in classes.values():
        imports.setdefault(module, set()).add(name)
    handed_on = {port.type_name: port.name for port in taken.values() if port.required}
    module, _, class_name = start.spec.target.partition(":") if start else ("", "", "")
    start_takes = port_specs(start.load().In) if start else {}
    return KindPorts(
        inputs=tuple(
            Port(name=port.name, class_name=classes[port.type_name][1], required=port.required)
            for port in taken.values()
        ),
        outputs=tuple(
            Port(
                name=port.name,
                class_name=classes[port.type_name][1],
                required=port.required,
                same_as=handed_on.get(port.type_name, ""),
            )
            for port in given.values()
        ),
        imports={module: tuple(sorted(names)) for module, names in sorted(imports.items())},
        needs=_needs(catalog, types, besides),
        start_module=module,
        start_class=class_name,
        start_id=start.spec.id if start else "",
        start_inputs=tuple(name for name in taken if name in start_takes),
    )


def _maker(catalog: Catalog, takes: Sequence[str], gives: Sequence[str]) -> MethodEntry | None:
    """Return an installed method that makes some product types from others, or None."""
    for entry in catalog.methods.values():
        try:
            taken, given = _declared(entry)
        except PluginError:
            continue
        required = {port.name: port.type_name for port in taken.values() if port.required}
        has_all = all(name in given and given[name].type_name == name for name in gives)
        if (
            required
            and has_all
            and all(name == type_ and name in takes for name, type_ in required.items())
        ):
            return entry
    return None


def _needs(
    catalog: Catalog, type_names: Iterable[str], besides: Iterable[DistributionInfo]
) -> tuple[str, ...]:
    """Return requirements for other distributions than orthoflow, sorted by name."""
    of_types = (catalog.products[name].distribution for name in type_names if name != FILES)
    # A version after `>=` cannot contain a local part.
    versions = {
        one.name: one.version.partition("+")[0]
        for one in (*of_types, *besides)
        if one.name != DISTRIBUTION
    }
    return tuple(f"{name}>={version}" for name, version in sorted(versions.items()))


def _declared(start: MethodEntry) -> tuple[Mapping[str, PortSpec], Mapping[str, PortSpec]]:
    method = start.load()
    return port_specs(method.In), port_specs(method.Out)


def _class_of(catalog: Catalog, type_name: str) -> tuple[str, str]:
    if type_name == FILES:
        return products.__name__, products.InputFiles.__name__
    module, _, name = catalog.products[type_name].spec.target.partition(":")
    return (products.__name__, name) if name in products.__all__ else (module, name)
