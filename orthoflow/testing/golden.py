"""Golden results: recorded samples of a method's results that reveal unintended changes.

The exact bits of a result also depend on the processor and on the versions of numerical libraries.
Therefore, the file contains samples of the numbers, which must be reproduced within the tolerances
of the product types. Metadata values that describe a result have no tolerance, and shares of few
cells can change considerably with the last bits of the inputs. Such values are compared only if the
samples of the inputs are the same.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from orthoflow.engine.durability import lock_file
from orthoflow.errors import InputError
from orthoflow.products import JsonValue, Product
from orthoflow.products.product import Payload, Tolerance
from orthoflow.testing.trials import Trial

_AT_MOST: Final = 32
# Share of cells that may differ, since a cell at an edge can change sides with the last bit of a
# number.
_STRAY_SHARE: Final = 1 / 16
# As in comparisons of records, only the last digits may differ if no tolerance is declared.
_UNSTATED: Final = 1e-6
# Tolerance of metadata values that describe a result, such as medians or counts. Without wide
# processor instructions, such a value of a built-in method changed by 3e-4, while all arrays were
# within their tolerances.
_METADATA_SHARE: Final = 1e-2
_DIGITS: Final = 9
_ROUNDING: Final = 10.0 ** (1 - _DIGITS)
# An odd number that does not divide raster sizes, so that consecutive samples are far apart.
_STRIDE: Final = 2_654_435_761
_METADATA: Final = "metadata"


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Sample of the numbers in an array.

    Attributes:
        shape: shape of the array.
        values: up to 32 of its values with nine digits, at positions that depend only on its size;
            None for NaN.
    """

    shape: Sequence[int]
    values: Sequence[float | None]


@dataclass(frozen=True, kw_only=True)
class Golden:
    """Recorded results of a method, and the conditions under which they were computed.

    Attributes:
        result_version: result version of the method.
        tools: library versions declared by the method; other versions may give other results.
        params: parameters that differ from the defaults, as JSON.
        inputs: samples of each array by port, without files.
        outputs: samples of each array by port.
    """

    result_version: int
    tools: Mapping[str, str]
    params: str
    inputs: Mapping[str, Mapping[str, Sample]]
    outputs: Mapping[str, Mapping[str, Sample]]


_FORMAT: Final = TypeAdapter(dict[str, Golden])


def golden_problem(file: Path, trial: Trial, outputs: Mapping[str, Product]) -> str:
    """Compare results with the file, or record them if the file has no comparable results.

    Results are recorded if the method is new in the file, if its result version, tools or
    parameters are different, or if the inputs, which are results of other methods, have changed.

    Args:
        file: JSON file by method id, created if missing.
        trial: the method and its inputs.
        outputs: products by port.

    Returns:
        One sentence if a result changed without a new `result_version`; otherwise empty.

    Raises:
        InputError: the file is not a golden file.
    """
    inputs = {port: given for port, given in trial.inputs.items() if isinstance(given, Product)}
    now = Golden(
        result_version=trial.method.result_version,
        tools=dict(trial.method.tools()),
        params=json.dumps(dict(trial.params), sort_keys=True),
        inputs={port: sample_of(product) for port, product in inputs.items()},
        outputs={port: sample_of(product) for port, product in outputs.items()},
    )
    # Other processes, which test other methods, use the same file.
    with file.open("a+", encoding="utf-8") as stream:
        lock_file(file, stream.fileno(), waits=True)
        stream.seek(0)
        known = _parsed(stream.read(), file)
        if (before := known.get(trial.method.id)) is None or not _is_of_the_same(
            before, now, inputs
        ):
            stream.truncate(0)
            stream.write(_text({**known, trial.method.id: now}))
            return ""
    for port in sorted({*before.outputs, *now.outputs}):
        moved = "one of them has none"
        if port in before.outputs and port in outputs:
            moved = sample_problem(
                before.outputs[port],
                now.outputs[port],
                outputs[port].tolerances,
                numbers_stated=before.inputs == now.inputs,
            )
        if moved:
            return (
                f"output {port} differs from {file.name} ({moved}), but result_version is still "
                f"{now.result_version}: increment it, or find out why the result has changed"
            )
    return ""


def _is_of_the_same(before: Golden, now: Golden, inputs: Mapping[str, Product]) -> bool:
    """Return whether two results are of the same method, parameters and inputs."""
    return (
        replace(before, inputs={}, outputs={}) == replace(now, inputs={}, outputs={})
        and before.inputs.keys() == now.inputs.keys()
        and not any(
            sample_problem(before.inputs[port], now.inputs[port], product.tolerances)
            for port, product in inputs.items()
        )
    )


def _parsed(text: str, file: Path) -> dict[str, Golden]:
    try:
        return _FORMAT.validate_json(text) if text else {}
    except ValidationError as error:
        raise InputError(
            f"{file.name} is not a valid file of golden results ({error.error_count()} errors): "
            "remove it, and the next run writes a new one"
        ) from error


def _text(known: Mapping[str, Golden]) -> str:
    text = json.dumps(_FORMAT.dump_python(dict(known)), indent=1, sort_keys=True)
    # One line per list of numbers, so that version control shows which of them changed.
    return re.sub(r"\[[^\[\]]+\]", lambda found: " ".join(found[0].split()), text) + "\n"


def sample_of(product: Product) -> dict[str, Sample]:
    """Return a sample of each array, and of the numbers in the metadata; bytes are omitted.

    A single changed pixel changes all bytes of a compressed image.
    """
    payload = product.to_payload()
    samples = {
        name: _sample(np.asarray(array))
        for name, array in payload.arrays.items()
        if not _is_bytes(payload, name)
    }
    stated = np.array(list(_numbers(dict(payload.metadata))), dtype=np.float64)
    return {**samples, _METADATA: _sample(stated)}


def sample_problem(
    before: Mapping[str, Sample],
    after: Mapping[str, Sample],
    tolerances: Mapping[str, Tolerance],
    *,
    numbers_stated: bool = True,
) -> str:
    """Return the differences between two samples that exceed tolerances; empty if there are none.

    Args:
        before: sample of the first product.
        after: sample of the second product.
        tolerances: tolerances of the product type.
        numbers_stated: also compare the numbers in the metadata, not only their count.
    """
    for name in sorted({*before, *after}):
        if name not in before or name not in after:
            return f"only one of them has {name}"
        old, new = before[name], after[name]
        if list(old.shape) != list(new.shape):
            return f"{name} had {list(old.shape)} values, now {list(new.shape)}"
        if name == _METADATA and not numbers_stated:
            continue
        amount, share = _limit(name, tolerances)
        a, b = (np.array(sample.values, dtype=np.float64) for sample in (old, new))
        is_close = np.isclose(a, b, atol=amount, rtol=share + _ROUNDING, equal_nan=True)
        n_apart = np.count_nonzero(~is_close)
        if n_apart > _STRAY_SHARE * len(old.values):
            return f"{n_apart} of {len(old.values)} sampled values of {name} changed"
    return ""


def _sample(array: NDArray[np.generic]) -> Sample:
    flat = array.reshape(-1)
    if flat.size > _AT_MOST:
        flat = flat[np.arange(1, _AT_MOST + 1) * _STRIDE % flat.size]
    values = [float(value) for value in flat]
    return Sample(
        shape=list(array.shape),
        values=[float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None for value in values],
    )


def _limit(name: str, tolerances: Mapping[str, Tolerance]) -> tuple[float, float]:
    """Return the tolerance of two numbers: an absolute value, and a share of the larger number."""
    if name == _METADATA:
        return _UNSTATED, _METADATA_SHARE
    tolerance = tolerances.get(name.rpartition("/")[2])
    return (_UNSTATED, _UNSTATED) if tolerance is None else (tolerance.limit, 0.0)


def _is_bytes(payload: Payload, name: str) -> bool:
    node: JsonValue = dict(payload.metadata)
    for part in name.split("/"):
        if isinstance(node, dict):
            node = node[part]
        elif isinstance(node, list):
            node = node[int(part)]
    return node == {"$array": "bytes"}


def _numbers(node: JsonValue) -> Iterator[float]:
    if isinstance(node, dict):
        for value in node.values():
            yield from _numbers(value)
    elif isinstance(node, list):
        for value in node:
            yield from _numbers(value)
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield float(node)
