"""Time from the start of the command until its first picture is on the disk.

Each case is a separate process: ``cold``, with empty caches; ``seen``, the same scene again; ``new``, scenes with
combinations of shapes, materials, lights and textures that are not in the caches, once each; ``quality``, the first
scene at the preset ``high``; ``high``, another scene at that preset. ``WARP_AR_BENCH`` may name cases, separated by
commas. Elapsed time is measured, and processor time of all threads, on which other programs have little effect.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from bench.common import report
from warp_ar.scene import bundled_scenes

CASES = ("cold", "seen", "new", "quality", "high")
_BOX = '[[proxy]]\nshape = "box"\nat = [0.0, 0.21, 0.0446]\nsize = [0.2, 0.075, 0.09]\n'
_TABLE = '[[proxy]]\nshape = "plane"\nat = [0.0, 0.0, -0.0004]\nsize = [1.6, 1.2]\n'
_SPHERE = '[[object]]\nshape = "sphere"\nradius = 0.03\nat = [0.12, 0.05, 0.03]\n[object.material]\nmodel = "{model}"\n'
_POINT = '[[light]]\nkind = "point"\nat = [0.1, 0.0, 0.4]\ncolor = [1.0, 0.9, 0.6]\nintensity = 0.2\nradius = 0.02\n'
_SUN = '[[light]]\nkind = "directional"\ndirection = [0.3, 0.2, -1.0]\ncolor = [1.0, 1.0, 1.0]\nintensity = 0.5\n'
NEW: Mapping[str, str] = {
    "sphere, point light": _TABLE + _SPHERE.format(model="lambert") + "base_color = [0.8, 0.3, 0.2]\n" + _POINT,
    "box, two lights": _TABLE + _BOX + _SPHERE.format(model="phong") + "diffuse = [0.2, 0.4, 0.7]\n" + _POINT + _SUN,
    "mirror, no light": _TABLE + _BOX + _SPHERE.format(model="mirror"),
}
"""Objects, lights and proxies in combinations that no bundled scene has; the rest of the scene is that of ``desk``."""


def write_scene(parts: str, folder: Path, name: str) -> Path:
    """Write a scene file with the camera, marker, ball and frames of ``desk`` and other parts; return its path."""
    desk = bundled_scenes()["desk"]
    text = desk.read_text(encoding="utf-8")
    head = text[: text.index("[[proxy]]")].replace('path = "', f'path = "{desk.parent.as_posix()}/')
    path = folder / f"{name}.toml"
    path.write_text(head + parts, encoding="utf-8")
    return path


def cache_variables(caches: Path) -> dict[str, str]:
    """Return the environment variables with which a process stores kernels, meshes and checks in a folder."""
    return {"WARP_CACHE_PATH": str(caches / "kernels"), "XDG_CACHE_HOME": str(caches)}


def start(scene: str, device: str, caches: Path, target: Path, quality: str = "medium") -> tuple[float, float]:
    """Return the milliseconds until the first picture is written, and those of processor time.

    Args:
        scene: Name or path of the scene.
        device: Option ``--device``.
        caches: Folder of caches.
        target: Folder for the picture.
        quality: Name of the preset.
    """
    command = [sys.executable, "-m", "warp_ar.live", scene, "--headless", "--frames", "1", "--device", device]
    environment = {**os.environ, **cache_variables(caches)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # bytecode is cached, as for an installed package
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([*command, "--quality", quality, "--output", str(target)], env=environment, check=True)
    spent, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent * 1e3, busy * 1e3


def main(device: str) -> None:
    """Measure all cases, or those that ``WARP_AR_BENCH`` names."""
    wanted = set(filter(None, os.environ.get("WARP_AR_BENCH", "").split(","))) or set(CASES)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        runs = {"cold": ("desk", "medium")}
        runs |= {f"seen {number}": ("desk", "medium") for number in (1, 2, 3)} if "seen" in wanted else {}
        if "new" in wanted:
            for number, (label, parts) in enumerate(NEW.items()):
                runs[f"new, {label}"] = (str(write_scene(parts, root, f"new_{number}")), "medium")
        if "quality" in wanted:
            runs["new quality high"] = ("desk", "high")
        if "high" in wanted:
            runs["new scene high"] = ("torus", "high")
        for number, (label, (scene, quality)) in enumerate(runs.items()):
            wall, busy = start(scene, device, root / "caches", root / f"out_{number}", quality)
            load = round(os.getloadavg()[0], 1)
            report(f"start {label}", [wall], device, processor_ms=round(busy), cores=os.cpu_count(), load=load)
