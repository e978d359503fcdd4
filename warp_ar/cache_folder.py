"""Folder for files that are kept between runs and can be made again."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder for cached files of the current user's programs."""
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "warp_ar"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "warp_ar" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "warp_ar"
    return Path.home() / ".cache" / "warp_ar"
