"""The one door to open3d: loads what its wheel forgets, and says in one sentence why it cannot."""

from __future__ import annotations

import ctypes
from importlib import import_module
from typing import Any

from orthoflow.errors import PluginError


# Any: the library has no types.
def load_open3d(purpose: str) -> Any:
    """Import open3d.

    Its wheel needs libusb-1.0.so.0, which fresh machines lack; the package libusb-package carries
    it, and once loaded globally it is found.

    Args:
        purpose: what needs it, for the message.

    Raises:
        PluginError: it is not installed or does not load.
    """
    try:
        usb = import_module("libusb_package")
        ctypes.CDLL(str(usb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        # The system may have libusb itself; if not, open3d says so below.
        pass
    try:
        return import_module("open3d")
    except ModuleNotFoundError as error:
        raise PluginError(
            f"{purpose} needs open3d, which is not installed: install it with "
            "`python -m pip install open3d-cpu libusb-package`, or take a method without it"
        ) from error
    except (ImportError, OSError) as error:
        raise PluginError(
            f"{purpose} needs open3d, which does not load ({str(error).splitlines()[0]}): install "
            "the system library that it names (Debian: apt-get install libgl1 libx11-6 "
            "libusb-1.0-0), or take a method without it"
        ) from error
