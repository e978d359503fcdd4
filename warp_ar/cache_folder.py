"""Folder of files that can be made again, kept between runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder in which this user's programs keep files that they can make again."""
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "warp_ar"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "warp_ar" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "warp_ar"
    return Path.home() / ".cache" / "warp_ar"
