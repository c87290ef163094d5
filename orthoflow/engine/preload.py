"""Libraries that steps need, loaded once in the process from which steps are forked.

Plugins are never loaded here, so that no third-party code runs in that process.
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
    """Load the libraries. Errors are ignored here, because the steps report them."""
    if address_space() is not None:
        # With a low limit on the address space, some libraries crash when they are loaded, and then
        # no step can be started.
        return
    for name in _LIBRARIES:
        with suppress(Exception):
            importlib.import_module(name)
            if name == "numba":
                _register_compiler()
    gc.collect()
    gc.freeze()


def _register_compiler() -> None:
    """Make numba register its types and functions, as it does for the first kernel.

    Registration takes longer than importing numba. Third-party numba extensions are not loaded
    here, but in each step.
    """
    from numba.core import entrypoints  # noqa: PLC0415 - only where numba is there
    from numba.core.registry import cpu_target  # noqa: PLC0415

    entrypoints._already_initialized = True  # noqa: SLF001 - numba offers nothing else
    try:
        cpu_target.target_context.refresh()
    finally:
        entrypoints._already_initialized = False  # noqa: SLF001


load_libraries()
