"""The examples: the same bits on every processor, and what methods need to show anything."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from orthoflow.engine.store import digest_of
from orthoflow.testing.golden import sample_of
from orthoflow.testing.photographed import (
    PHOTOGRAPHED,
)
from orthoflow.testing.surveyed import SURVEYED

_DIGESTS = """
import json
from orthoflow.engine.store import digest_of
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
both = {"surveyed": SURVEYED, "photographed": PHOTOGRAPHED}
print(json.dumps({f"{a} {b}": digest_of(make()) for a in both for b, make in both[a].items()}))
"""


def test_examples_keep_their_bits_without_wide_instructions() -> None:
    switched_off = {"NPY_DISABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_CORETYPE": "Nehalem"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _DIGESTS],
        env={**os.environ, **switched_off, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    both = {"surveyed": SURVEYED, "photographed": PHOTOGRAPHED}
    here = {f"{a} {b}": digest_of(make()) for a in both for b, make in both[a].items()}
    assert json.loads(done.stdout) == here


# Examples that methods of ours take, each held by what they gave for it.
TAKEN = {
    "surveyed": ("cloud", "planes"),
    "photographed": ("photos", "cameras", "ties", "walls", "layers", "cloud"),
}


def test_golden_results_are_of_these_examples() -> None:
    """Where an example moved, every result of it would be recorded anew and none be held."""
    golden = json.loads((Path(__file__).parents[1] / "golden.json").read_text())
    recorded = [item for result in golden.values() for item in result["inputs"].items()]
    for scene, makers in (("surveyed", SURVEYED), ("photographed", PHOTOGRAPHED)):
        for port in TAKEN[scene]:
            samples = sample_of(makers[port]())
            taken = (port, {name: asdict(sample) for name, sample in samples.items()})
            assert taken in recorded, (scene, port)
