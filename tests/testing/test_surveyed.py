"""The examples: the same bits on every processor, and what methods need to show anything."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from orthoflow.engine.store import digest_of
from orthoflow.testing.golden import sample_of
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED

_DIGESTS = """
import json
from orthoflow.engine.store import digest_of
from orthoflow.testing.photographed import PHOTOGRAPHED
from orthoflow.testing.surveyed import SURVEYED
scenes = (SURVEYED, PHOTOGRAPHED)
print(json.dumps([digest_of(make()) for scene in scenes for make in scene.values()]))
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
    scenes = (SURVEYED, PHOTOGRAPHED)
    here = [digest_of(make()) for scene in scenes for make in scene.values()]
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
            assert (port, sample_of(makers[port]())) in recorded, (scene, port)
