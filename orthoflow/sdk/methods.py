"""The classes a method is made of: its parameters, its ports, and what it does."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, ClassVar, Final, Literal, Union, dataclass_transform

from pydantic import BaseModel, ConfigDict

from orthoflow.errors import PluginError
from orthoflow.sdk.context import Metric, StepContext
from orthoflow.sdk.lines import is_name, one_line
from orthoflow.sdk.units import unit_of

Determinism = Literal["exact", "seeded", "loose"]
_BETTER: Final = ("", "lower", "higher", "one")
_WILDCARD: Final = re.compile(r"(\*|\[[^\]]+\])")


class MethodParams(BaseModel):
    """Base of a method's parameters: frozen, unknown keys refused.

    Every field has a default, a description and its unit at the end of its name.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Ports:
    """Base of a method's `In` and `Out`: annotate one product class per port.

    `X | None = None` makes a port optional. Subclasses become frozen dataclasses by themselves.
    """

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True, kw_only=True)(cls)


@dataclass(frozen=True, kw_only=True)
class PortSpec:
    """One port as a method declares it.

    Attributes:
        name: name of the port.
        type_name: product type it carries; `files` for a workflow input.
        required: must be wired and present.
    """

    name: str
    type_name: str
    required: bool


def port_specs(ports: type[Ports]) -> Mapping[str, PortSpec]:
    """Ports of an `In` or `Out` class by name, read from its annotations.

    Raises:
        PluginError: an annotation is not a product class, or product class | None.
    """
    # Any: mypy does not let a class be the key of a cache.
    return _port_specs(typing.cast("Any", ports))


@cache
def _port_specs(ports: Any) -> Mapping[str, PortSpec]:
    hints = typing.get_type_hints(ports)
    specs: dict[str, PortSpec] = {}
    for field in dataclasses.fields(ports):
        hint = hints[field.name]
        alternatives = (
            typing.get_args(hint)
            if typing.get_origin(hint) in (Union, types.UnionType)
            else (hint,)
        )
        classes = [item for item in alternatives if item is not types.NoneType]
        type_name = getattr(classes[0], "type_name", None) if len(classes) == 1 else None
        if not isinstance(type_name, str):
            raise PluginError(
                f"{ports.__qualname__}.{field.name} must be annotated with a product class, or "
                f"that class | None, got {hint}"
            )
        required = len(classes) == len(alternatives)
        specs[field.name] = PortSpec(name=field.name, type_name=type_name, required=required)
    return types.MappingProxyType(specs)


@dataclass(frozen=True)
class MetricSpec:
    """A metric that a method may report.

    Attributes:
        name: of the metric; with the wildcards of file names (`*`, `[xy]`) where a part depends on
            the data.
        unit: `mm`, `px`, `s`, ...; `1` for counts and shares, `yes/no` for 1 and 0; empty where the
            name ends in it.
        label: what reports call it, e.g. `damp patches`; its name where it is empty. `{0}`, `{1}`
            stand for what the wildcards match.
        better: `lower`, `higher` or `one`: which values are better; empty where none are: then it
            is shown, and nobody is best in it.
        description: what else to know of it, e.g. how it is measured: one sentence.
        headline: it shows how good the result is: it stands on the first screen of a report, and
            comparisons show it unless they ask for others.
        counted_by: metric of the same step that counts the items (photos, points) it sums up:
            values over unequal numbers of them are not ranked.
        needs: optional input ports without which it is not reported.
    """

    name: str
    unit: str = ""
    label: str = ""
    better: Literal["", "lower", "higher", "one"] = ""
    description: str = ""
    headline: bool = False
    counted_by: str = ""
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not is_name(self.name) or (self.label and not is_name(self.label, also_of_file=False)):
            raise PluginError(
                f"name and label of a metric must be printable lines of at most 200 bytes, got "
                f"{one_line(ascii(self.name), 80)} and {one_line(ascii(self.label), 80)}"
            )
        if self.better not in _BETTER:
            raise PluginError(
                f"metric {self.name}: better must be lower, higher, one or empty, got "
                f"{self.better!r}"
            )
        if not (self.unit or unit_of(self.name)):
            object.__setattr__(self, "unit", "1")
        elif not self.unit:
            object.__setattr__(self, "unit", unit_of(self.name))


class Method:
    """Base of all methods.

    A method implements `run`.

    Attributes:
        id: `kind.method`.
        result_version: raised by the author whenever results change for equal inputs.
        determinism: `exact` (same bits always), `seeded` (same bits for the same seed) or
            `loose` (equal within the products' tolerances).
        metrics: all metrics that it may report: a `MetricSpec` each, or just its name. A
            comparison that asks for another one is refused; empty where the author declares none:
            then nothing is refused.
        citations: where the method comes from: DOI, title or URL.
        unaffected_by: distributions whose version does not change results, although the method's
            own distribution requires them; all others are part of a result's key.
        repeatable: input ports of files of which several may have the same content, such as masks;
            of all others a second copy would count twice, and is refused.
        Params: parameters.
        In: input ports.
        Out: output ports.
    """

    id: ClassVar[str]
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[MetricSpec | str, ...]] = ()
    citations: ClassVar[tuple[str, ...]] = ()
    unaffected_by: ClassVar[tuple[str, ...]] = ()
    repeatable: ClassVar[tuple[str, ...]] = ()
    Params: ClassVar[type[MethodParams]]
    In: ClassVar[type[Ports]]
    Out: ClassVar[type[Ports]]

    # Any: each method narrows inputs and params to its own nested classes, which no common
    # supertype can express without making every author write three type parameters.
    def run(self, inputs: Any, params: Any, ctx: StepContext) -> Any:
        """Compute the outputs.

        Args:
            inputs: an instance of `In`; arrays are read-only.
            params: an instance of `Params`.
            ctx: seed, cores, scratch folder, and where metrics, figures and progress go.

        Returns:
            An instance of `Out`.

        Raises:
            OrthoflowError: no result is possible; one sentence states why.
        """
        raise AssertionError(f"{type(self).__name__} must implement run")

    @classmethod
    def may_report(cls, metric: str) -> bool:
        """Whether a metric is one of those declared; True where none are."""
        return not cls.metrics or cls.metric_spec(metric) is not None

    @classmethod
    def metric_specs(cls) -> tuple[MetricSpec, ...]:
        """All metrics that it declares, a bare name as the spec of that name."""
        return tuple(one if isinstance(one, MetricSpec) else MetricSpec(one) for one in cls.metrics)

    @classmethod
    def metric_spec(cls, metric: str) -> MetricSpec | None:
        """The declaration of a metric by its name, by a pattern where no name is the same."""
        specs = cls.metric_specs()
        exact = next((spec for spec in specs if spec.name == metric), None)
        return exact or next((spec for spec in specs if fnmatchcase(metric, spec.name)), None)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Return versions besides those of the libraries that the distribution requires."""
        return {}


def labelled(method: type[Method], metrics: Iterable[Metric]) -> tuple[Metric, ...]:
    """Add to metrics what their method declares of them, so that records know it."""
    found = []
    for metric in metrics:
        spec = method.metric_spec(metric.name)
        if spec is None:
            found.append(metric)
            continue
        label = spec.label.format(*matched(spec.name, metric.name))
        found.append(
            replace(
                metric,
                unit=spec.unit if spec.unit == "yes/no" else metric.unit,
                label=label,
                better=spec.better,
                description=spec.description,
                headline=spec.headline,
                counted_by=spec.counted_by,
            )
        )
    return tuple(found)


def matched(pattern: str, name: str) -> tuple[str, ...]:
    """Return what the wildcards of a pattern match in a name, with `_` as spaces.

    >>> matched("wall_*_rmse_[uv]_mm", "wall_3_rmse_u_mm")
    ('3', 'u')
    """
    parts = _WILDCARD.split(pattern)
    expression = "".join(
        f"({'.*' if part == '*' else part})" if index % 2 else re.escape(part)
        for index, part in enumerate(parts)
    )
    found = re.fullmatch(expression, name)
    return tuple(part.replace("_", " ") for part in found.groups()) if found else ()
