"""Import of classes by import string, and checks of the classes of methods."""

from __future__ import annotations

import pkgutil
import typing
from collections.abc import Mapping

from orthoflow.catalog.distributions import DistributionInfo
from orthoflow.catalog.guarding import UserInterrupt, guarded
from orthoflow.errors import PluginError
from orthoflow.sdk.hooks import FILES, KindSpec, MethodSpec
from orthoflow.sdk.lines import describe_error
from orthoflow.sdk.methods import (
    Determinism,
    Method,
    MethodParams,
    MetricSpec,
    Ports,
    PortSpec,
    port_specs,
)


def import_target(target: str, what: str, distribution: DistributionInfo) -> object:
    """Import `package.module:Name`.

    Args:
        target: import string.
        what: description for error messages, e.g. `method plane.hough2d`.
        distribution: distribution that declares it, for error messages.

    Raises:
        PluginError: the module cannot be imported or does not contain the name.
    """
    try:
        with guarded():
            return typing.cast("object", pkgutil.resolve_name(target))
    except UserInterrupt:
        raise
    except BaseException as error:
        raise PluginError(
            f"{what} of {distribution} cannot be loaded from {target}: {describe_error(error)}; "
            f"install missing packages or another version of {distribution.name}, or correct its "
            "source code"
        ) from error


def load_method(
    spec: MethodSpec,
    kind: KindSpec,
    distribution: DistributionInfo,
    product_types: frozenset[str],
) -> type[Method]:
    """Import the class of a method and check it against its spec and its kind.

    Raises:
        PluginError: the import fails or the class violates a rule.
    """
    method = import_target(spec.target, f"method {spec.id}", distribution)
    broken = f"method {spec.id} of {distribution} is invalid: "
    if not (isinstance(method, type) and issubclass(method, Method)):
        raise PluginError(f"{broken}{spec.target} must be a subclass of Method, got {method!r}")
    complaint = _class_complaint(method, spec)
    if not complaint:
        try:
            complaint = _port_complaint(method, kind, product_types)
        except (PluginError, NameError, TypeError) as error:
            complaint = f"its ports cannot be read: {describe_error(error)}"
    if complaint:
        raise PluginError(broken + complaint)
    return method


def _class_complaint(method: type[Method], spec: MethodSpec) -> str:
    own_id: object = getattr(method, "id", None)
    version: object = method.result_version
    citations: object = method.citations
    metrics: object = method.metrics
    rules = {
        f"the id of its class must be {spec.id}, got {own_id!r}": own_id == spec.id,
        "its Params must be a subclass of MethodParams": _is_subclass(
            getattr(method, "Params", None), MethodParams
        ),
        "its In must be a subclass of Ports": _is_subclass(getattr(method, "In", None), Ports),
        "its Out must be a subclass of Ports": _is_subclass(getattr(method, "Out", None), Ports),
        f"determinism must be exact, seeded or loose, got {method.determinism!r}": (
            method.determinism in typing.get_args(Determinism)
        ),
        f"result_version must be an integer of at least 1, got {version!r}": (
            type(version) is int and version >= 1
        ),
        f"citations must be a tuple of strings, got {citations!r}": (
            isinstance(citations, tuple) and all(isinstance(item, str) for item in citations)
        ),
        f"metrics must be a tuple of MetricSpec or of names, got {metrics!r}": (
            isinstance(metrics, tuple)
            and all(isinstance(one, MetricSpec | str) and one for one in metrics)
        ),
        "it has no method run": method.run is not Method.run,
    }
    return next((complaint for complaint, is_kept in rules.items() if not is_kept), "")


def _is_subclass(candidate: object, parent: type) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, parent)


def _port_complaint(method: type[Method], kind: KindSpec, product_types: frozenset[str]) -> str:
    taken, given = port_specs(method.In), port_specs(method.Out)
    if kind.is_source:
        return _unknown_type(taken, product_types | {FILES}) or _unknown_type(given, product_types)
    for port in taken.values():
        if port.name not in kind.inputs:
            return f"kind {kind.name} has no input port {port.name}; it has {_join(kind.inputs)}"
        if port.type_name != kind.inputs[port.name]:
            return (
                f"input port {port.name} has the type {kind.inputs[port.name]} in kind "
                f"{kind.name}, not {port.type_name}"
            )
    for port in given.values():
        wanted = kind.outputs.get(port.name, port.type_name)
        if port.type_name != wanted:
            return (
                f"output port {port.name} has the type {wanted} in kind {kind.name}, not "
                f"{port.type_name}"
            )
    if given.keys() != kind.outputs.keys():
        return (
            f"its outputs must be {_join(kind.outputs)} as in kind {kind.name}, got {_join(given)}"
        )
    return ""


def _unknown_type(ports: Mapping[str, PortSpec], known: frozenset[str]) -> str:
    for port in ports.values():
        if port.type_name not in known:
            return (
                f"port {port.name} has the product type {port.type_name}, which no plugin declares"
            )
    return ""


def _join(names: Mapping[str, object]) -> str:
    return ", ".join(names) or "none"
