"""Finding plugins: a loop over entry points in which no plugin can harm another."""

from __future__ import annotations

import dataclasses
import os
import re
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from importlib.metadata import EntryPoint
from typing import Final, Generic, TypeVar

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
from orthoflow.catalog.wording import describe_error
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
from orthoflow.version import DISTRIBUTION

# Windows takes the first ones for devices; addresses and files are named after names.
NAME_PATTERN: Final = (
    r"(?!(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?![a-z0-9_-]))[a-z][a-z0-9_-]{0,31}"
)
_METHOD_ID: Final = re.compile(rf"{NAME_PATTERN}\.{NAME_PATTERN}")
_KIND: Final = re.compile(NAME_PATTERN)
_TARGET: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")

_Spec = TypeVar("_Spec", MethodSpec, KindSpec, ProductSpec)


@dataclass(frozen=True, kw_only=True)
class _Claim(Generic[_Spec]):
    """A spec and who announced it."""

    spec: _Spec
    distribution: DistributionInfo


@dataclass(frozen=True, kw_only=True)
class _Announcement:
    """What one plugin brings."""

    distribution: DistributionInfo
    methods: tuple[MethodSpec, ...]
    kinds: tuple[KindSpec, ...]
    products: tuple[ProductSpec, ...]


def discover_catalog(entry_points: Iterable[EntryPoint] | None = None) -> Catalog:
    """List everything that the installed plugins bring.

    Plugins that `ORTHOFLOW_DISABLED_PLUGINS` names, by distribution or entry point and with `,`
    between, are left out.

    Args:
        entry_points: plugins to look at; None for all installed ones.
    """
    found = _installed_entry_points() if entry_points is None else entry_points
    announcements: list[_Announcement] = []
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
            with guarded(f"plugin {entry.name} of {distribution}"):
                announcements.append(_announce(entry, distribution))
        except UserInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - plugins may raise anything, even SystemExit
            broken.append(_describe_failure(entry, distribution, error))
    products = _collect_products(announcements)
    kinds = _collect_kinds(announcements, frozenset(products))
    methods = _collect_methods(announcements, kinds, products)
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
        # One unreadable file spoils that for all. A distribution may be found twice; the first
        # counts, as on import.
        return _readable_entry_points()


def _readable_entry_points() -> tuple[EntryPoint, ...]:
    found: dict[str, list[EntryPoint]] = {}
    for distribution in metadata.distributions():
        try:
            entries = distribution.entry_points.select(group=ENTRY_POINT_GROUP)
            found.setdefault(distribution.name, list(entries))
        except ValueError:
            continue
    return tuple(entry for entries in found.values() for entry in entries)


def _announce(entry: EntryPoint, distribution: DistributionInfo) -> _Announcement:
    # One manager per plugin: with a shared one, the second plugin of a name is dropped in silence.
    manager = pluggy.PluginManager(PROJECT)
    manager.add_hookspecs(PluginHooks)
    manager.register(entry.load(), entry.name)
    manager.check_pending()
    announcement = _Announcement(
        distribution=distribution,
        methods=_specs(manager.hook.orthoflow_methods(), MethodSpec),
        kinds=_specs(manager.hook.orthoflow_kinds(), KindSpec),
        products=_specs(manager.hook.orthoflow_products(), ProductSpec),
    )
    _check_spelling(announcement)
    if not (announcement.methods or announcement.kinds or announcement.products):
        raise PluginError(
            f"{entry.value} announces nothing; give it a function orthoflow_methods with @hookimpl"
        )
    return announcement


def _specs(answers: Iterable[object], spec_class: type[_Spec]) -> tuple[_Spec, ...]:
    specs: list[_Spec] = []
    for answer in answers:
        if not isinstance(answer, list | tuple):
            raise PluginError(f"expected a list of {spec_class.__name__}, got {answer!r}")
        for item in answer:
            if not isinstance(item, spec_class):
                raise PluginError(f"expected a {spec_class.__name__}, got {item!r}")
            _check_fields(item)
            specs.append(item)
    return tuple(specs)


def _check_fields(spec: MethodSpec | KindSpec | ProductSpec) -> None:
    """Check the types of a spec's fields, which a dataclass takes as they come."""
    for item in dataclasses.fields(spec):
        value: object = getattr(spec, item.name)
        texts = (*value, *value.values()) if isinstance(value, Mapping) else (value,)
        is_fine = all(isinstance(text, str) for text in texts)
        if item.name == "is_source":
            is_fine = isinstance(value, bool)
        if item.name in ("inputs", "outputs"):
            is_fine = is_fine and isinstance(value, Mapping)
        if not is_fine:
            raise PluginError(f"{item.name} of a {type(spec).__name__} cannot be {value!r}")


def _check_spelling(announcement: _Announcement) -> None:
    for method in announcement.methods:
        if not _METHOD_ID.fullmatch(method.id):
            raise PluginError(
                f"method id must be kind.method in lower case, e.g. plane.mine, got {method.id!r}"
            )
    for name in [
        *(kind.name for kind in announcement.kinds),
        *(product.type_name for product in announcement.products),
    ]:
        if not _KIND.fullmatch(name):
            raise PluginError(f"kind and product names must match {NAME_PATTERN}, got {name!r}")
    for target in [
        *(method.target for method in announcement.methods),
        *(product.target for product in announcement.products),
        *(product.publisher for product in announcement.products if product.publisher),
    ]:
        if not _TARGET.fullmatch(target):
            raise PluginError(f"target must be package.module:Name, got {target!r}")


def _describe_failure(
    entry: EntryPoint, distribution: DistributionInfo, error: BaseException
) -> BrokenPlugin:
    return BrokenPlugin(
        entry_point=entry.name,
        module=entry.value,
        distribution=distribution,
        error=f"{describe_error(error)}{_way_out(entry, error)}",
        traceback="".join(traceback.format_exception(error)),
    )


def _way_out(entry: EntryPoint, error: BaseException) -> str:
    """State who names a module that does not exist; nothing of any other failure."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing is None or not f"{entry.module}.".startswith(f"{missing}."):
        return ""
    return (
        f'; its entry point in pyproject.toml names it: mend {entry.name} = "{entry.value}" in '
        f'[project.entry-points."{ENTRY_POINT_GROUP}"], and install it again'
    )


def _by_name(
    announcements: Iterable[_Announcement], specs_of: Callable[[_Announcement], Iterable[_Spec]]
) -> dict[str, list[_Claim[_Spec]]]:
    """Who claims each name: orthoflow itself first, then by the names of distributions."""
    claims: dict[str, list[_Claim[_Spec]]] = {}
    for announcement in sorted(
        announcements, key=lambda item: item.distribution.name != DISTRIBUTION
    ):
        for spec in specs_of(announcement):
            claim = _Claim(spec=spec, distribution=announcement.distribution)
            claims.setdefault(_name(spec), []).append(claim)
    return claims


def _name(spec: MethodSpec | KindSpec | ProductSpec) -> str:
    if isinstance(spec, MethodSpec):
        return spec.id
    return spec.name if isinstance(spec, KindSpec) else spec.type_name


def _contested(what: str, claims: list[_Claim[_Spec]], consequence: str) -> str:
    claimants = " and ".join(str(claim.distribution) for claim in claims)
    return f"{what} is claimed by {claimants}: {consequence}; {DISABLED}=NAME switches a plugin off"


def _collect_products(announcements: Iterable[_Announcement]) -> dict[str, ProductEntry]:
    entries: dict[str, ProductEntry] = {}
    for name, claims in _by_name(announcements, lambda item: item.products).items():
        first = claims[0]
        problem = ""
        if len({(claim.spec.target, claim.spec.publisher) for claim in claims}) > 1:
            problem = _contested(
                f"product type {name}", claims, f"the one of {first.distribution.name} is used"
            )
        entries[name] = ProductEntry(
            spec=first.spec, distribution=first.distribution, problem=problem
        )
    return entries


def _collect_kinds(
    announcements: Iterable[_Announcement], product_types: frozenset[str]
) -> dict[str, KindEntry]:
    entries: dict[str, KindEntry] = {}
    for name, claims in _by_name(announcements, lambda item: item.kinds).items():
        first = claims[0]
        state: EntryState = "fine"
        problem = _unknown_products(first, product_types)
        if problem:
            state = "broken"
        elif any(_ports(claim.spec) != _ports(first.spec) for claim in claims):
            # The same ports again do no harm: two plugins may both need a kind of their own.
            problem = _contested(
                f"kind {name}", claims, "methods have the ports that their own plugin gives it"
            )
        entries[name] = KindEntry(
            spec=first.spec, distribution=first.distribution, state=state, problem=problem
        )
    return entries


def _unknown_products(claim: _Claim[KindSpec], product_types: frozenset[str]) -> str:
    spec = claim.spec
    unknown = sorted(
        ({*spec.inputs.values()} - product_types - {FILES})
        | ({*spec.outputs.values()} - product_types)
    )
    if not unknown:
        return ""
    return (
        f"kind {spec.name} of {claim.distribution} has ports of product types that no plugin "
        f"announces: {', '.join(unknown)}"
    )


def _ports(spec: KindSpec) -> tuple[dict[str, str], dict[str, str], bool]:
    return dict(spec.inputs), dict(spec.outputs), spec.is_source


def _collect_methods(
    announcements: list[_Announcement],
    kinds: dict[str, KindEntry],
    products: dict[str, ProductEntry],
) -> dict[str, MethodEntry]:
    own_kinds = {
        (item.distribution.name, kind.name): _Claim(spec=kind, distribution=item.distribution)
        for item in announcements
        for kind in item.kinds
    }
    product_types = frozenset(products)
    contested = {name: entry.spec.target for name, entry in products.items() if entry.problem}

    def entry_of(claim: _Claim[MethodSpec]) -> MethodEntry:
        spec, who = claim.spec, f"method {claim.spec.id} of {claim.distribution}"
        own, shared = own_kinds.get((claim.distribution.name, spec.kind)), kinds.get(spec.kind)
        problem = ""
        if shared is None:
            problem = f"{who} is of kind {spec.kind}, which no plugin announces"
        elif unusable := (
            _unknown_products(own, product_types)
            if own
            else (shared.problem if shared.state != "fine" else "")
        ):
            problem = f"{who} cannot be used: {unusable}"
        return MethodEntry(
            spec=spec,
            distribution=claim.distribution,
            kind=own.spec if own else shared.spec if shared else None,
            product_types=product_types,
            contested=contested,
            state="broken" if problem else "fine",
            problem=problem,
        )

    entries: dict[str, MethodEntry] = {}
    for name, claims in _by_name(announcements, lambda item: item.methods).items():
        first = entry_of(claims[0])
        if len(claims) == 1:
            entries[name] = first
            continue
        named = [f"{canonical_name(claim.distribution.name)}/{name}" for claim in claims]
        if claims[0].distribution.name == DISTRIBUTION:
            entries[name] = first
        else:
            problem = _contested(f"method {name}", claims, f"write {' or '.join(named)}")
            entries[name] = dataclasses.replace(first, state="clash", problem=problem)
        entries |= dict(zip(named, map(entry_of, claims), strict=True))
    return entries
