"""Libraries that every step needs, loaded once in the process from which steps are forked.

Never a plugin: no third-party code runs in the process from which others are forked.
"""

from __future__ import annotations

import gc
import importlib
from contextlib import suppress
from typing import Final

from orthoflow.geometry.threads import address_space

_LIBRARIES: Final = (
    "numba",
    "scipy.interpolate",
    "scipy.linalg",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.spatial",
    "scipy.stats",
    "cv2",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "PIL.JpegImagePlugin",
    "rasterio",
    "orthoflow.engine.worker",
    "orthoflow.files.publishing",
    "orthoflow_provenance.arrays",
)


def load_libraries() -> None:
    """Load libraries; steps report their errors."""
    if address_space() is not None:
        # Some crash with too little memory, and every step with them.
        return
    for name in _LIBRARIES:
        with suppress(Exception):
            importlib.import_module(name)
            if name == "numba":
                _register_compiler()
    gc.collect()
    gc.freeze()


def _register_compiler() -> None:
    """Let numba register what it can compile, as it does for the first kernel of a process.

    That takes longer than loading numba. Its extensions, which third parties install, are loaded in
    each step.
    """
    from numba.core import entrypoints  # noqa: PLC0415 - only where numba is there
    from numba.core.registry import cpu_target  # noqa: PLC0415

    entrypoints._already_initialized = True  # noqa: SLF001 - numba offers nothing else
    try:
        cpu_target.target_context.refresh()
    finally:
        entrypoints._already_initialized = False  # noqa: SLF001


load_libraries()
