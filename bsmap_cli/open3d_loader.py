"""The one place where Open3D is imported: it takes seconds, and it needs shared libraries that many machines lack."""

import ctypes
import importlib
import re
from typing import Any

from bsmap_cli.errors import MissingLibraryError

DEBIAN_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libEGL": "libegl1",
    "libGL": "libgl1",
    "libX11": "libx11-6",
    "libgomp": "libgomp1",
    "libudev": "libudev1",
    "libidn2": "libidn2-0",
}


def load() -> Any:
    """Module open3d; MissingLibraryError names the shared library that is missing and how to install it."""
    _provide_libusb()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingLibraryError(_explanation(str(error))) from error


def _provide_libusb() -> None:
    """Load the libusb of the package libusb-package where the system has none; Open3D then finds it by its soname."""
    if _can_load("libusb-1.0.so.0"):
        return
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return  # the import of Open3D will tell what is missing
    if path is not None:
        _can_load(str(path))


def _can_load(library: str) -> bool:
    try:
        ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True


def _explanation(message: str) -> str:
    """One line from the loader's message, e.g. 'libEGL.so.1: cannot open shared object file: ...'."""
    found = re.search(r"(lib[\w+-]+(?:\.\d+)*)(\.so[.\d]*): cannot open shared object", message)
    if found is None:
        return f"Open3D cannot be imported ({message}); install it with: pip install open3d-cpu"
    library, package = "".join(found.groups()), DEBIAN_PACKAGES.get(found[1])
    if package is None:
        return f"Open3D needs the shared library {library}; find its package with: apt-file search {library}"
    return f"Open3D needs the shared library {library}; install it with: apt-get install {package}"
