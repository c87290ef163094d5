"""Sources of numbers and scans."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from orthoflow.errors import InputError
from orthoflow.products import InputFiles
from orthoflow.sdk import Method, MethodParams, Ports, StepContext
from toy_plugin import products


class Count(MethodParams):
    count: int = Field(4, ge=1, description="How many.")


class Nothing(Ports):
    pass


class Files(Ports):
    files: InputFiles


class OfNumbers(Ports):
    numbers: products.Numbers


class OfScan(Ports):
    scan: products.Scan


class Range(Method):
    id = "make.range"
    Params, In, Out = Count, Nothing, OfNumbers

    def run(self, inputs: Nothing, params: Count, ctx: StepContext) -> OfNumbers:
        ctx.metric("count", params.count, "1")
        return OfNumbers(numbers=products.Numbers(values=np.arange(float(params.count))))


class Scan(Method):
    id = "make.scan"
    Params, In, Out = Count, Nothing, OfScan

    def run(self, inputs: Nothing, params: Count, ctx: StepContext) -> OfScan:
        return OfScan(scan=products.Scan(values=np.sqrt(np.arange(2000.0 * params.count))))


class File(Method):
    id = "make.file"
    Params, In, Out = MethodParams, Files, OfNumbers

    def run(self, inputs: Files, params: MethodParams, ctx: StepContext) -> OfNumbers:
        try:
            values = [float(word) for word in inputs.files.paths[0].read_text().split()]
        except ValueError as error:
            raise InputError(f"{inputs.files.paths[0].name} must hold numbers: {error}") from error
        return OfNumbers(numbers=products.Numbers(values=np.array(values)))


class Survey(Method):
    id = "make.survey"
    Params, In, Out = MethodParams, Files, OfScan

    def run(self, inputs: Files, params: MethodParams, ctx: StepContext) -> OfScan:
        numbers = [float(word) for word in inputs.files.paths[0].read_text().split()]
        values = ctx.allocate("scan", "values", (1000 * len(numbers),), np.float64)
        values[:] = np.outer(numbers, np.sqrt(np.arange(1000.0))).ravel()
        return OfScan(scan=products.Scan(values=values))
