"""Which program this is: what must be the same on every worker, for their pictures to be of one kind."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
from pathlib import Path

import warp_ar

_LIBRARIES = ("warp-lang", "numpy", "opencv-contrib-python-headless", "av")
"""Of what else pictures and their bytes depend on."""


@functools.cache
def program_version() -> str:
    """Version of the package, a digest of its code, and the libraries' versions, on one line."""
    root = Path(warp_ar.__file__).parent
    digest = hashlib.sha256()
    for folder in (root, root / "kernels"):  # a link, which rglob does not follow
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    parts = [f"warp_ar {_version('warp-ar')} {digest.hexdigest()[:12]}"]
    return ", ".join([*parts, *(f"{name} {_version(name)}" for name in _LIBRARIES)])


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "?"
