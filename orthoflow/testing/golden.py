"""Golden results: recorded samples of a method's results that reveal unintended changes.

The exact bits of a result also depend on the processor and on the versions of numerical libraries.
Therefore, the file contains samples of the numbers, which must be reproduced within the tolerances
of the product types. The products declare no tolerances for metadata that describe a result, and
some of these values, such as a share of a few cells, can change considerably with the last bits of
the inputs. Metadata are therefore compared only if the samples of the inputs are the same.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from orthoflow.engine.durability import lock_file
from orthoflow.errors import InputError
from orthoflow.products import JsonValue, Product
from orthoflow.products.product import Tolerance
from orthoflow.testing.trials import Trial

_AT_MOST: Final = 32
# Share of the sampled values that may differ, since a rounding error can assign a cell at an edge
# to the other side of the edge.
_STRAY_SHARE: Final = 1 / 16
# Absolute and relative tolerance of values for which none is declared, as in comparisons of
# records.
_UNSTATED: Final = 1e-6
# Relative tolerance of metadata that describe a result, such as medians or counts. On a processor
# without wide vector instructions, such a value of a built-in method changed by 3e-4, although all
# arrays were within their tolerances.
_METADATA_SHARE: Final = 1e-2
_DIGITS: Final = 9
_ROUNDING: Final = 10.0 ** (1 - _DIGITS)
# This odd number does not divide raster sizes, so consecutive samples are far apart.
_STRIDE: Final = 2_654_435_761
_METADATA: Final = "metadata"

# For each array, by its name and shape: up to 32 values with nine digits, at positions that depend
# only on the array's size; None for NaN.
Samples: TypeAlias = Mapping[str, Sequence[float | None]]


@dataclass(frozen=True, kw_only=True)
class Golden:
    """Recorded results of a method, and the conditions under which they were computed.

    Attributes:
        result_version: result version of the method.
        tools: library versions declared by the method; other versions may give different results.
        params: parameters that differ from the defaults, as JSON.
        inputs: samples of the input arrays by port; files are omitted.
        outputs: samples of the output arrays by port.
    """

    result_version: int
    tools: Mapping[str, str]
    params: str
    inputs: Mapping[str, Samples]
    outputs: Mapping[str, Samples]


_FORMAT: Final = TypeAdapter(dict[str, Golden])


def golden_problem(file: Path, trial: Trial, outputs: Mapping[str, Product]) -> str:
    """Compare results with the file, or record them if the file has no comparable results.

    Results are recorded if the method is new in the file, if its result version, tools or
    parameters are different, or if the inputs, which are results of other methods, have changed.

    Args:
        file: JSON file with results by method id; created if missing.
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
    # Processes that test other methods may use the same file.
    with file.open("a+", encoding="utf-8") as stream:
        lock_file(file, stream.fileno(), waits=True)
        stream.seek(0)
        known = _parsed(stream.read(), file)
        before = known.get(trial.method.id, now)
        is_same = replace(before, inputs={}, outputs={}) == replace(now, inputs={}, outputs={})
        if before is now or not is_same or any(_changes(before.inputs, now.inputs, inputs)):
            known[trial.method.id] = now
            text = json.dumps(_FORMAT.dump_python(known), indent=1, sort_keys=True)
            stream.truncate(0)
            # Write each list of numbers on one line, so that version control shows which lists
            # changed.
            stream.write(re.sub(r"\[[^\[\]]+\]", lambda it: " ".join(it[0].split()), text) + "\n")
            return ""
    is_equal = before.inputs == now.inputs
    for port, moved in _changes(before.outputs, now.outputs, outputs, numbers_stated=is_equal):
        return (
            f"output {port} differs from {file.name} ({moved}), but result_version is still "
            f"{now.result_version}: increment it, or find out why the result has changed"
        )
    return ""


def _changes(
    before: Mapping[str, Samples],
    after: Mapping[str, Samples],
    products: Mapping[str, Product],
    *,
    numbers_stated: bool = True,
) -> Iterator[tuple[str, str]]:
    for port in sorted({*before, *after}):
        tolerances = products[port].tolerances if port in products else {}
        pair = before.get(port, {}), after.get(port, {})
        if moved := sample_problem(*pair, tolerances, numbers_stated=numbers_stated):
            yield port, moved


def _parsed(text: str, file: Path) -> dict[str, Golden]:
    try:
        return _FORMAT.validate_json(text) if text else {}
    except ValidationError as error:
        raise InputError(
            f"{file.name} is not a valid file of golden results ({error.error_count()} errors): "
            "remove it, and the next run writes a new one"
        ) from error


def sample_of(product: Product) -> Samples:
    """Return a sample of each array, and of the numbers in the metadata.

    Bytes are omitted because a single changed pixel changes all bytes of a compressed image.
    """
    payload = product.to_payload()
    stated = dict(_leaves(dict(payload.metadata)))
    arrays = {
        name: np.asarray(array)
        for name, array in payload.arrays.items()
        if stated[f"/{name}/$array"] != "bytes"
    }
    numbers = [one for one in stated.values() if type(one) in (int, float)]
    arrays[_METADATA] = np.array(numbers, dtype=np.float64)
    return {f"{name} {list(array.shape)}": _sampled(array) for name, array in arrays.items()}


def sample_problem(
    before: Samples,
    after: Samples,
    tolerances: Mapping[str, Tolerance],
    *,
    numbers_stated: bool = True,
) -> str:
    """Return the first difference between two samples that exceeds a tolerance, or an empty string.

    Args:
        before: sample of the first product.
        after: sample of the second product.
        tolerances: tolerances of the product type.
        numbers_stated: compare the numbers in the metadata, too; otherwise only their count is
            compared.
    """
    for array in sorted(before.keys() ^ after.keys()):
        return f"only one of the results has {array}"
    for array, values in before.items():
        name = array.partition(" [")[0]
        if name == _METADATA and not numbers_stated:
            continue
        # Absolute tolerance, and relative tolerance as a share of the larger number.
        stated = tolerances.get(name.rpartition("/")[2])
        amount, share = (_UNSTATED, _UNSTATED) if stated is None else (stated.limit, 0.0)
        share = _METADATA_SHARE if name == _METADATA else share
        a, b = (np.array(sampled, dtype=np.float64) for sampled in (values, after[array]))
        is_close = np.isclose(a, b, atol=amount, rtol=share + _ROUNDING, equal_nan=True)
        n_apart = np.count_nonzero(~is_close)
        if n_apart > _STRAY_SHARE * len(a):
            return f"{n_apart} of {len(a)} sampled values of {name} changed"
    return ""


def _sampled(array: NDArray[np.generic]) -> list[float | None]:
    flat = array.reshape(-1)
    if flat.size > _AT_MOST:
        flat = flat[np.arange(1, _AT_MOST + 1) * _STRIDE % flat.size]
    values = [float(value) for value in flat]
    return [float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None for value in values]


def _leaves(node: JsonValue, path: str = "") -> Iterator[tuple[str, JsonValue]]:
    if not isinstance(node, dict | list):
        yield path, node
        return
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield from _leaves(value, f"{path}/{key}")
