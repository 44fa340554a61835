import sys

import pytest

from bsmap_cli import open3d_loader
from bsmap_cli.errors import MissingLibraryError


def broken_open3d(tmp_path, monkeypatch, message):
    (tmp_path / "open3d.py").write_text(f"raise ImportError({message!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)


@pytest.mark.parametrize(
    ("library", "package"),
    [
        ("libusb-1.0.so.0", "libusb-1.0-0"),
        ("libEGL.so.1", "libegl1"),
        ("libGL.so.1", "libgl1"),
        ("libX11.so.6", "libx11-6"),
        ("libgomp.so.1", "libgomp1"),
    ],
)
def test_missing_library_is_named_with_its_package(tmp_path, monkeypatch, library, package):
    broken_open3d(tmp_path, monkeypatch, f"{library}: cannot open shared object file: No such file or directory")
    with pytest.raises(MissingLibraryError, match=f"{library}; install it with: apt-get install {package}$"):
        open3d_loader.load()


def test_unknown_library_is_named(tmp_path, monkeypatch):
    broken_open3d(tmp_path, monkeypatch, "libc++abi.so.1: cannot open shared object file: No such file or directory")
    with pytest.raises(MissingLibraryError, match=r"libc\+\+abi.so.1; find its package"):
        open3d_loader.load()


def test_any_other_failure_names_the_python_package(tmp_path, monkeypatch):
    broken_open3d(tmp_path, monkeypatch, "No module named 'open3d'")
    with pytest.raises(MissingLibraryError, match="pip install open3d-cpu"):
        open3d_loader.load()


def test_open3d_loads_here():
    assert hasattr(open3d_loader.load().t.geometry, "RaycastingScene")
