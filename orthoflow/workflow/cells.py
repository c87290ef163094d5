"""Cells: what a workflow's steps and variants become, one per method call that really differs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from orthoflow.products.product import JsonValue


@dataclass(frozen=True, kw_only=True)
class CellOutput:
    """An output of another cell."""

    address: str
    port: str

    def __str__(self) -> str:
        return f"{self.address}.{self.port}"


@dataclass(frozen=True, kw_only=True)
class WorkflowInput:
    """One of the workflow's inputs."""

    name: str

    def __str__(self) -> str:
        return f"inputs.{self.name}"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One method call of a run.

    Attributes:
        address: `step`, or `step@step=variant,...` with the variants that reach it in graph
            order, and `#n` behind it for repeats 1, 2, ...
        step: name of the step.
        assignment: step -> variant for every varied step that reaches this cell, itself included.
        repeat: 0 for the first; downstream cells use the first.
        method: method id.
        params: resolved parameters, defaults included, JSON.
        params_set: parameters as written in the file or set on the command line, JSON.
        inputs: port -> where it comes from; ports that the method ignores and optional ones that
            are absent are left out.
        seed: derived from (workflow seed, method id, repeat).
        cores: cores asked for in `resources`, or None for all.
        timeout_s: seconds, or None.
        skip_reason: why the cell will not run (optional data absent), empty when it will.
    """

    address: str
    step: str
    method: str
    assignment: Mapping[str, str] = field(default_factory=dict)
    repeat: int = 0
    params: Mapping[str, JsonValue] = field(default_factory=dict)
    params_set: Mapping[str, JsonValue] = field(default_factory=dict)
    inputs: Mapping[str, CellOutput | WorkflowInput] = field(default_factory=dict)
    seed: int = 0
    cores: int | None = None
    timeout_s: float | None = None
    skip_reason: str = ""
