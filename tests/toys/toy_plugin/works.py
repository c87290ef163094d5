"""Methods that work on numbers."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from toy_plugin.makes import OfNumbers, OfScan
from toy_plugin.products import Numbers

Values = NDArray[np.float64]


class Amount(MethodParams):
    amount: float = Field(1.0, description="How much.")
    steps: int = Field(0, description="How many steps.")
    code: str = Field("", description="What to do.")


class Work(Method):
    Params, In, Out = Amount, OfNumbers, OfNumbers

    def run(self, inputs: OfNumbers, params: Amount, ctx: StepContext) -> Ports:
        values = self.work(inputs.numbers.values, params, ctx)
        return OfNumbers(numbers=Numbers(values=np.asarray(values)))

    def work(self, values: Values, params: Amount, ctx: StepContext) -> Values:
        return values + params.amount


class Add(Work):
    id = "work.add"


class Noise(Work):
    id = "work.noise"
    determinism = "seeded"

    def work(self, values: Values, params: Amount, ctx: StepContext) -> Values:
        return values + params.amount * ctx.rng.standard_normal(values.shape)


class Slow(Work):
    id = "work.slow"

    def work(self, values: Values, params: Amount, ctx: StepContext) -> Values:
        for index in range(params.steps):
            ctx.progress(index / params.steps, f"step {index}")
            time.sleep(0.05)
        return values + params.amount


class Draws(Work):
    id = "work.draws"

    def work(self, values: Values, params: Amount, ctx: StepContext) -> Values:
        ctx.figure("dot", b"\x89PNG\r\n\x1a\n0123", "a dot")
        ctx.warn("the dot is small")
        ctx.metric("dots", 1, "1")
        return values


class Does(Work):
    """Runs `code`, which finds `values` and `ctx`, and may give other `values` or a `result`."""

    id = "work.does"

    def run(self, inputs: OfNumbers, params: Amount, ctx: StepContext) -> Ports:
        names = {"values": inputs.numbers.values, "inputs": inputs, "ctx": ctx}
        modules = "ctypes, os, signal, subprocess, sys, threading, time, numpy as np"
        exec(f"import {modules}\nfrom toy_plugin import products\n{params.code}", names)
        numbers = Numbers(values=np.asarray(names["values"]))
        return names.get("result", OfNumbers(numbers=numbers))


class Means(Method):
    id = "thin.means"
    Params, In, Out = MethodParams, OfScan, OfNumbers

    def run(self, inputs: OfScan, params: MethodParams, ctx: StepContext) -> OfNumbers:
        means = inputs.scan.values.reshape(-1, 1000).mean(axis=1)
        return OfNumbers(numbers=Numbers(values=means))
