"""The quick half of the checks, kept for the next run of the same scene: it takes a second.

It is made anew where the scene, a file that it names, a frame or the code that checks differs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import pickle
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from warp_ar.cache_folder import cache_folder
from warp_ar.checks.finding import Finding
from warp_ar.files import write_whole
from warp_ar.scene import Scene

_PACKAGE: Final = Path(__file__).parents[1]
_CODE: Final = ("ball", "calibration", "checks", "kernels", "scene", "sources", "tracking")
"""Packages that decide what is found."""
_NOT_LOOKED: Final = ("source.", "units.", "marker.", "picture.", "camera.aspect", "ball.unfound", "ball.outside")
"""What findings begin with after which a ball was not looked for, or one of several not seen."""


@dataclasses.dataclass(frozen=True)
class QuickCheck:
    """What the quick half of the checks found."""

    findings: tuple[Finding, ...]
    """The worst first."""
    ball_seen: bool
    """Whether a frame shows every mirror ball of the scene, which has one."""


def quick_check(scene: Scene, given: str | int | Path | None, files: Iterable[Path]) -> QuickCheck:
    """What a look at the first frames, if they were recorded, says of a set-up.

    Args:
        scene: The scene.
        given: Its frames, unless they are the scene's own.
        files: Those that the scene names.
    """
    from warp_ar.checks.checkup import source_of

    source = source_of(scene, given)
    if not isinstance(source, Path) and not (isinstance(source, str) and Path(source).exists()):
        return _check(scene, None)
    kept = _kept_at(scene, source)
    key = _key(scene, Path(source), files)
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        values = json.loads(kept.read_text(encoding="utf-8"))
        if values["key"] == key:
            return QuickCheck(tuple(Finding(*map(str, each)) for each in values["findings"]), bool(values["ball_seen"]))
    checked = _check(scene, source)
    values = {
        "key": key,
        "findings": [(each.name, each.text, each.remedy) for each in checked.findings],
        "ball_seen": checked.ball_seen,
    }
    with contextlib.suppress(OSError):  # a disk that is full or read-only only costs the time again
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_whole(kept, json.dumps(values).encode())
    return checked


def _check(scene: Scene, source: str | Path | None) -> QuickCheck:
    from warp_ar.checks import checkup

    found = tuple(checkup.check_up(scene, source, quick=True))
    seen = source is not None and bool(scene.probes) and not any(each.name.startswith(_NOT_LOOKED) for each in found)
    return QuickCheck(found, seen)


def _kept_at(scene: Scene, source: str | Path) -> Path:
    """One file for a scene and its frames, so that there are not more of them with each change of the scene."""
    name = hashlib.sha256(f"{scene.path}\0{Path(source).absolute()}".encode(errors="surrogateescape")).hexdigest()[:32]
    return cache_folder() / "checks" / f"{name}.json"


def _key(scene: Scene, source: Path, files: Iterable[Path]) -> str:
    """Tells apart what decides the findings."""
    import cv2
    import numpy as np

    known = hashlib.sha256(pickle.dumps(scene))
    known.update(f"{cv2.__version__} {np.__version__}".encode())
    for folder in _CODE:
        for path in sorted((_PACKAGE / folder).rglob("*.py")):
            known.update(_stamp(path))
    for path in [source, *files]:
        for file in _files_in(path):
            known.update(_stamp(file))
    return known.hexdigest()


def _files_in(path: Path) -> Iterator[Path]:
    """A file, or those of a folder."""
    yield path
    if path.is_dir():
        yield from sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))


def _stamp(path: Path) -> bytes:
    """Name, size and time of a file."""
    try:
        stat = path.stat()
    except OSError:
        return f"{path} is not there\0".encode(errors="surrogateescape")
    return f"{path} {stat.st_size} {stat.st_mtime_ns}\0".encode(errors="surrogateescape")
