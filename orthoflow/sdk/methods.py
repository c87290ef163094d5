"""The classes a method is made of: its parameters, its ports, and what it does."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, ClassVar, Literal, Union, dataclass_transform

from pydantic import BaseModel, ConfigDict

from orthoflow.errors import PluginError
from orthoflow.sdk.context import StepContext

Determinism = Literal["exact", "seeded", "loose"]


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


def port_specs(ports: type[Ports]) -> dict[str, PortSpec]:
    """Ports of an `In` or `Out` class by name, read from its annotations.

    Raises:
        PluginError: an annotation is not a product class, or product class | None.
    """
    hints = typing.get_type_hints(ports)
    specs: dict[str, PortSpec] = {}
    for field in dataclasses.fields(typing.cast("Any", ports)):
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
    return specs


class Method:
    """Base of all methods.

    Attributes:
        id: `kind.method`.
        result_version: raised by the author whenever results change for equal inputs.
        determinism: `exact` (same bits always), `seeded` (same bits for the same seed) or
            `loose` (equal within the products' tolerances).
        metrics: names of all metrics that it may report, with the wildcards of file names (`*`,
            `[xy]`) where a part hangs on the data. A comparison that asks for another one is
            refused; empty where the author declares none: then nothing is refused.
        citations: where the method comes from: DOI, title or URL.
        Params: parameters.
        In: input ports.
        Out: output ports.
    """

    id: ClassVar[str]
    result_version: ClassVar[int] = 1
    determinism: ClassVar[Determinism] = "exact"
    metrics: ClassVar[tuple[str, ...]] = ()
    citations: ClassVar[tuple[str, ...]] = ()
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
            OrthoflowError: no result is possible; one sentence says why.
        """
        raise AssertionError(f"{type(self).__name__} must implement run")

    @classmethod
    def may_report(cls, metric: str) -> bool:
        """Whether a metric is one of those declared; True where none are."""
        return not cls.metrics or any(fnmatchcase(metric, name) for name in cls.metrics)

    @classmethod
    def tools(cls) -> Mapping[str, str]:
        """External libraries whose version changes results, with their versions."""
        return {}
