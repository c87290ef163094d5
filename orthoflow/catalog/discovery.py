"""Discovery of plugins through entry points; an error in one plugin does not affect the others."""

from __future__ import annotations

import dataclasses
import os
import re
import traceback
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import metadata
from importlib.metadata import EntryPoint
from typing import Final, TypeAlias, TypeVar

import pluggy

from orthoflow.catalog.catalog import (
    DISABLED,
    BrokenPlugin,
    Catalog,
    EntryState,
    KindEntry,
    MethodEntry,
    ProductEntry,
)
from orthoflow.catalog.distributions import (
    DistributionInfo,
    canonical_name,
    describe_distribution,
)
from orthoflow.catalog.guarding import UserInterrupt, guarded
from orthoflow.errors import PluginError
from orthoflow.sdk.hooks import (
    ENTRY_POINT_GROUP,
    FILES,
    PROJECT,
    KindSpec,
    MethodSpec,
    PluginHooks,
    ProductSpec,
)
from orthoflow.sdk.lines import describe_error
from orthoflow.version import DISTRIBUTION

# Windows device names are excluded because files are named after methods and steps.
NAME_PATTERN: Final = (
    r"(?!(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?![a-z0-9_-]))[a-z][a-z0-9_-]{0,31}"
)
_METHOD_ID: Final = re.compile(rf"{NAME_PATTERN}\.{NAME_PATTERN}")
_KIND: Final = re.compile(NAME_PATTERN)
_TARGET: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")

_Spec = TypeVar("_Spec", MethodSpec, KindSpec, ProductSpec)
# A spec and the distribution that declares it.
_AnyClaim: TypeAlias = tuple[MethodSpec | KindSpec | ProductSpec, DistributionInfo]


def discover_catalog(entry_points: Iterable[EntryPoint] | None = None) -> Catalog:
    """Return the content of the installed plugins.

    Plugins listed in `ORTHOFLOW_DISABLED_PLUGINS` (comma-separated distributions or entry points)
    are omitted.

    Args:
        entry_points: entry points of plugins; None for all installed ones.
    """
    found = _installed_entry_points() if entry_points is None else entry_points
    claims: list[_AnyClaim] = []
    broken: list[BrokenPlugin] = []
    named = {canonical_name(name) for name in os.environ.get(DISABLED, "").split(",")}
    disabled: list[str] = []
    described = [(entry, describe_distribution(entry)) for entry in found]
    for entry, distribution in sorted(
        described, key=lambda item: (item[1].name, item[0].name, item[0].value)
    ):
        if {canonical_name(entry.name), canonical_name(distribution.name)} & named:
            disabled.append(entry.name)
            continue
        try:
            with guarded():
                claims += [(spec, distribution) for spec in _announced(entry)]
        except UserInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - plugins may raise anything, even SystemExit
            broken.append(_describe_failure(entry, distribution, error))
    # Built-in entries come first.
    claims.sort(key=lambda claim: claim[1].name != DISTRIBUTION)
    products = _collect_products(_by_name(claims, ProductSpec))
    by_kind = _by_name(claims, KindSpec)
    kinds = _collect_kinds(by_kind, frozenset(products))
    methods = _collect_methods(_by_name(claims, MethodSpec), by_kind, kinds, products)
    return Catalog(
        methods=methods,
        kinds=kinds,
        products=products,
        broken=tuple(broken),
        disabled=tuple(disabled),
    )


def _installed_entry_points() -> Iterable[EntryPoint]:
    try:
        return metadata.entry_points(group=ENTRY_POINT_GROUP)
    except ValueError:
        # `metadata.entry_points` fails completely if one distribution is unreadable. A distribution
        # may be found twice; as in imports, the first one is used.
        found: dict[str, list[EntryPoint]] = {}
        for distribution in metadata.distributions():
            with suppress(ValueError):
                entries = distribution.entry_points.select(group=ENTRY_POINT_GROUP)
                found.setdefault(distribution.name, list(entries))
        return tuple(entry for entries in found.values() for entry in entries)


def _announced(entry: EntryPoint) -> list[MethodSpec | KindSpec | ProductSpec]:
    # One manager per plugin: a shared one silently drops the second plugin with the same name.
    manager = pluggy.PluginManager(PROJECT)
    manager.add_hookspecs(PluginHooks)
    manager.register(entry.load(), entry.name)
    manager.check_pending()
    specs: list[MethodSpec | KindSpec | ProductSpec] = []
    for answers, spec_class in (
        (manager.hook.orthoflow_methods(), MethodSpec),
        (manager.hook.orthoflow_kinds(), KindSpec),
        (manager.hook.orthoflow_products(), ProductSpec),
    ):
        for answer in answers:
            if not isinstance(answer, list | tuple):
                raise PluginError(
                    f"a hook must return a list of {spec_class.__name__}, got {answer!r}"
                )
            for item in answer:
                if not isinstance(item, spec_class):
                    raise PluginError(
                        f"a hook must return a list of {spec_class.__name__}, got an item {item!r}"
                    )
                _check(item)
                specs.append(item)
    if not specs:
        raise PluginError(
            f"{entry.value} declares nothing; add a function orthoflow_methods with @hookimpl"
        )
    return specs


def _check(spec: MethodSpec | KindSpec | ProductSpec) -> None:
    ports = (*spec.inputs.items(), *spec.outputs.items()) if isinstance(spec, KindSpec) else ()
    if not all(isinstance(text, str) for port in ports for text in port):
        raise PluginError(f"ports and product types of kind {_name(spec)} must be strings")
    name = _name(spec)
    if isinstance(spec, MethodSpec) and not _METHOD_ID.fullmatch(name):
        raise PluginError(
            f"method id must be kind.method in lower case, e.g. plane.mine, got {name!r}"
        )
    if not (isinstance(spec, MethodSpec) or _KIND.fullmatch(name)):
        raise PluginError(
            "the name of a kind or product must be at most 32 lower-case letters, digits, `_` and "
            f"`-`, begin with a letter and not be a reserved Windows device name, got "
            f"{name!r}"
        )
    targets = [] if isinstance(spec, KindSpec) else [spec.target]
    if isinstance(spec, ProductSpec) and spec.publisher:
        targets.append(spec.publisher)
    for target in targets:
        if not _TARGET.fullmatch(target):
            raise PluginError(f"target must be package.module:Name, got {target!r}")


def _describe_failure(
    entry: EntryPoint, distribution: DistributionInfo, error: BaseException
) -> BrokenPlugin:
    return BrokenPlugin(
        entry_point=entry.name,
        module=entry.value,
        distribution=distribution,
        error=describe_error(error),
        traceback="".join(traceback.format_exception(error)),
    )


def _by_name(
    claims: Iterable[_AnyClaim], spec_class: type[_Spec]
) -> dict[str, list[tuple[_Spec, DistributionInfo]]]:
    found: dict[str, list[tuple[_Spec, DistributionInfo]]] = {}
    for spec, distribution in claims:
        if isinstance(spec, spec_class):
            found.setdefault(_name(spec), []).append((spec, distribution))
    return found


def _name(spec: MethodSpec | KindSpec | ProductSpec) -> str:
    if isinstance(spec, MethodSpec):
        return spec.id
    return spec.name if isinstance(spec, KindSpec) else spec.type_name


def _contested(what: str, claims: Iterable[_AnyClaim], consequence: str) -> str:
    claimants = " and ".join(str(distribution) for _, distribution in claims)
    return f"{what} is declared by {claimants}: {consequence}; {DISABLED}=NAME disables a plugin"


def _collect_products(
    claimed: Mapping[str, list[tuple[ProductSpec, DistributionInfo]]],
) -> dict[str, ProductEntry]:
    entries: dict[str, ProductEntry] = {}
    for name, claims in claimed.items():
        spec, distribution = claims[0]
        problem = ""
        if len({(other.target, other.publisher) for other, _ in claims}) > 1:
            used = f"the definition in {distribution.name} is used"
            problem = _contested(f"product type {name}", claims, used)
        entries[name] = ProductEntry(spec=spec, distribution=distribution, problem=problem)
    return entries


def _collect_kinds(
    claimed: Mapping[str, list[tuple[KindSpec, DistributionInfo]]], product_types: frozenset[str]
) -> dict[str, KindEntry]:
    entries: dict[str, KindEntry] = {}
    for name, claims in claimed.items():
        spec, distribution = claims[0]
        problem = _unknown_products(claims[0], product_types)
        state: EntryState = "broken" if problem else "fine"
        if not problem and any(_ports(other) != _ports(spec) for other, _ in claims):
            # Identical ports are harmless: two plugins may declare the same kind.
            problem = _contested(
                f"kind {name}", claims, "each method has the ports that its own plugin declares"
            )
        entries[name] = KindEntry(
            spec=spec, distribution=distribution, state=state, problem=problem
        )
    return entries


def _unknown_products(
    claim: tuple[KindSpec, DistributionInfo], product_types: frozenset[str]
) -> str:
    spec, distribution = claim
    unknown = sorted(
        ({*spec.inputs.values()} - product_types - {FILES})
        | ({*spec.outputs.values()} - product_types)
    )
    if not unknown:
        return ""
    return (
        f"kind {spec.name} of {distribution} has ports with product types that no plugin "
        f"declares: {', '.join(unknown)}"
    )


def _ports(spec: KindSpec) -> tuple[dict[str, str], dict[str, str], bool]:
    return dict(spec.inputs), dict(spec.outputs), spec.is_source


def _collect_methods(
    claimed: Mapping[str, list[tuple[MethodSpec, DistributionInfo]]],
    by_kind: Mapping[str, list[tuple[KindSpec, DistributionInfo]]],
    kinds: Mapping[str, KindEntry],
    products: Mapping[str, ProductEntry],
) -> dict[str, MethodEntry]:
    product_types = frozenset(products)

    def entry_of(spec: MethodSpec, distribution: DistributionInfo) -> MethodEntry:
        # A plugin's own kind takes precedence over a kind of the same name from another plugin.
        claims = by_kind.get(spec.kind, [])
        own = next((claim for claim in claims if claim[1].name == distribution.name), None)
        shared = kinds.get(spec.kind)
        who, problem = f"method {spec.id} of {distribution}", ""
        if shared is None:
            problem = f"{who} has the kind {spec.kind}, which no plugin declares"
        elif unusable := (
            _unknown_products(own, product_types)
            if own
            else (shared.problem if shared.state != "fine" else "")
        ):
            problem = f"{who} cannot be used: {unusable}"
        return MethodEntry(
            spec=spec,
            distribution=distribution,
            kind=own[0] if own else shared.spec if shared else None,
            product_types=product_types,
            state="broken" if problem else "fine",
            problem=problem,
        )

    entries: dict[str, MethodEntry] = {}
    for name, claims in claimed.items():
        every = [entry_of(*claim) for claim in claims]
        entries[name] = every[0]
        if len(claims) > 1:
            named = [f"{canonical_name(who.name)}/{name}" for _, who in claims]
            if claims[0][1].name != DISTRIBUTION:
                problem = _contested(f"method {name}", claims, f"write {' or '.join(named)}")
                entries[name] = dataclasses.replace(every[0], state="clash", problem=problem)
            entries |= dict(zip(named, every, strict=True))
    return entries
