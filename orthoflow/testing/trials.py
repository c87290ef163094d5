"""Runs of a method outside a workflow, for checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from orthoflow.engine.store import digest_of
from orthoflow.products import InputFiles, Product
from orthoflow.sdk import Method, Metric, StepContext, StepEvent
from orthoflow.sdk.context import Drawing, DrawnFigure


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A method with the inputs and parameters for a run.

    Attributes:
        method: class of the method.
        inputs: products by port.
        params: parameters that differ from the defaults.
        seed: seed of the random generator.
        cores: maximum number of threads.
    """

    method: type[Method]
    inputs: Mapping[str, Product | InputFiles]
    params: Mapping[str, object] = field(default_factory=dict)
    seed: int = 7
    cores: int = 1


@dataclass(frozen=True, kw_only=True)
class TrialRun:
    """Result of running a trial.

    Attributes:
        outputs: products by port.
        digests: digests of the products by port.
        drew_globally: whether numpy's global random generator was used.
        metrics: metrics reported by the method.
        figures: figures, in the scratch folder.
        events: progress, log lines and warnings, in order.
        fractions: progress as reported by the method, before the context makes it monotonic.
    """

    outputs: Mapping[str, Product]
    digests: Mapping[str, str]
    drew_globally: bool
    metrics: tuple[Metric, ...]
    figures: tuple[DrawnFigure, ...]
    events: tuple[StepEvent, ...]
    fractions: tuple[float, ...] = ()


@dataclass(kw_only=True)
class _WatchedContext(StepContext):
    fractions: list[float] = field(default_factory=list)
    draws: bool = True

    def figure(
        self, name: str, content: bytes | Callable[[], bytes] | Drawing, caption: str = ""
    ) -> None:
        if self.draws:
            super().figure(name, content, caption)

    def progress(self, fraction: float, text: str = "") -> None:
        self.fractions.append(float(fraction))
        super().progress(fraction, text)


def run_trial(
    trial: Trial, scratch: Path, *, is_cancelled: bool = False, draws: bool = True
) -> TrialRun:
    """Run a method once in an empty scratch folder.

    Args:
        trial: the trial.
        scratch: scratch folder, created if missing.
        is_cancelled: whether the step is cancelled before it starts.
        draws: whether to draw figures, which takes longer than many methods.

    Raises:
        OrthoflowError: raised by the method.
        AssertionError: the method returned an object that is not its `Out`.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    events: list[StepEvent] = []
    ctx = _WatchedContext(
        rng=np.random.default_rng(trial.seed),
        cores=trial.cores,
        scratch=scratch,
        listen=events.append,
        is_cancelled=lambda: is_cancelled,
        draws=draws,
    )
    method = trial.method
    state = _global_state()
    # Any, because the type of the returned value is checked below.
    returned: Any = method().run(method.In(**trial.inputs), method.Params(**trial.params), ctx)
    if not isinstance(returned, method.Out):
        got = type(returned).__name__
        raise AssertionError(f"{method.id} must return an instance of its Out, got {got}")  # noqa: TRY004 - a broken rule, as every other
    outputs = {name: value for name, value in vars(returned).items() if value is not None}
    return TrialRun(
        outputs=outputs,
        digests={name: digest_of(product) for name, product in outputs.items()},
        drew_globally=state != _global_state(),
        metrics=tuple(ctx.metrics),
        figures=tuple(ctx.figures),
        events=tuple(events),
        fractions=tuple(ctx.fractions),
    )


def _global_state() -> str:
    return repr(np.random.get_state())  # noqa: NPY002 - it is the global one that is watched
