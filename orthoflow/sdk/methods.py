"""Base classes of a method, its parameters and its ports."""

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
    """Base class of a method's parameters; they are frozen and reject unknown keys.

    Every field has a default and a description, and its name ends with its unit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Ports:
    """Base class of a method's `In` and `Out`, which annotate each port with a product class.

    `X | None = None` declares an optional port. Subclasses become frozen dataclasses automatically.
    """

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        dataclass(frozen=True, kw_only=True)(cls)


@dataclass(frozen=True, kw_only=True)
class PortSpec:
    """A port declared by a method.

    Attributes:
        name: name of the port.
        type_name: product type of the port; `files` for an input of the workflow.
        required: whether the port must be connected.
    """

    name: str
    type_name: str
    required: bool


def port_specs(ports: type[Ports]) -> Mapping[str, PortSpec]:
    """Return the ports of an `In` or `Out` class by name, from its annotations.

    Raises:
        PluginError: an annotation is neither a product class nor `product class | None`.
    """
    # Cast to Any because mypy does not accept a class as the key of a cache.
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
        name: name of the metric, with wildcards (`*`, `[xy]`) if a part depends on the data.
        unit: a unit such as `mm`, `px` or `s`; `1` for counts and shares; `yes/no` for 1 and 0;
            empty if the name ends with the unit.
        label: name in reports, e.g. `damp patches`; `{0}` and `{1}` are replaced by the matches of
            the wildcards. If empty, reports show the name.
        better: `lower`, `higher` or `one` (closer to 1), whichever is better; empty for metrics
            that are shown but not ranked.
        description: one sentence of further information, e.g. on how it is measured.
        headline: whether it measures the quality of the result. Such metrics are shown in the first
            section of a report, and in comparisons that do not select metrics.
        counted_by: metric of the same step that counts the items (photos or points) on which this
            metric is based; values based on different numbers of items are not ranked.
        needs: optional input ports that must be connected for the metric to be reported.
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
    """Base class of all methods.

    A method implements `run`.

    Attributes:
        id: `kind.method`.
        result_version: number that the author increments when results change for the same inputs.
        determinism: `exact` (always the same bits), `seeded` (the same bits for the same seed) or
            `loose` (equal within the tolerances of the products).
        metrics: all metrics that it may report, as `MetricSpec` or as a name. Unless this is empty,
            a comparison that selects another metric is rejected.
        citations: source of the method: DOI, title or URL.
        unaffected_by: required distributions whose version does not change results; the versions of
            all others are part of the cache key.
        repeatable: input ports, such as `masks`, for which several files may have the same content;
            for other ports, a second copy would count twice and is rejected.
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

    # Any, because each method narrows inputs and params to its own nested classes; with a generic
    # base class, every author would have to give three type parameters.
    def run(self, inputs: Any, params: Any, ctx: StepContext) -> Any:
        """Compute the outputs.

        Args:
            inputs: instance of `In`; arrays are read-only.
            params: instance of `Params`.
            ctx: random generator, cores, scratch folder, and methods to report metrics, figures and
                progress.

        Returns:
            An instance of `Out`.

        Raises:
            OrthoflowError: no result is possible; the message is one sentence with the reason.
        """
        raise AssertionError(f"{type(self).__name__} must implement run")

    @classmethod
    def may_report(cls, metric: str) -> bool:
        """Return whether a metric is declared; True if the method declares none."""
        return not cls.metrics or cls.metric_spec(metric) is not None

    @classmethod
    def metric_specs(cls) -> tuple[MetricSpec, ...]:
        """Return all declared metrics; a bare name becomes a spec with that name."""
        return tuple(one if isinstance(one, MetricSpec) else MetricSpec(one) for one in cls.metrics)

    @classmethod
    def metric_spec(cls, metric: str) -> MetricSpec | None:
        """Return the declaration with this exact name, or else with a pattern that matches it."""
        specs = cls.metric_specs()
        exact = next((spec for spec in specs if spec.name == metric), None)
        return exact or next((spec for spec in specs if fnmatchcase(metric, spec.name)), None)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """Return versions of tools other than the libraries that the distribution requires."""
        return {}


def labelled(method: type[Method], metrics: Iterable[Metric]) -> tuple[Metric, ...]:
    """Add the declarations of a method to its metrics, so that records contain them."""
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
    """Return what the wildcards of a pattern match in a name, with `_` replaced by spaces.

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
