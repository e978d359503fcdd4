"""Blender's Cycles with shadow catchers beside the pipeline: the same shot, the same captured light, the same truth.

    python -m bench.beside_cycles CASE ... --blender PYTHON [--frame N] [--samples N] [--quality high] [--out DIR]

CASE is a folder of truth that has ``scene_object.toml``; PYTHON an interpreter with ``bpy``. The frames up to N run
through the pipeline; camera, light and surfaces go to Blender as ``warp_ar.export`` writes them, proxies with the mean
reflectance that the reference finds in the frame. Cycles' picture lies over the plate in linear light. Only where the
truth differs is rendered and compared. One JSON line per case: ``kept`` is the mean FLIP to the truth there over that
of the camera's frame, with Cycles and with the pipeline; ``seconds`` are Cycles' and mean something on an idle machine
alone. Virtual lights are left out: a shadow catcher shows what they throw onto no surface.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from bench.common import commit
from bench.judge import decoded, encoded, truth_of
from warp_ar.accuracy.known_frame import KnownFrame, light_up_to
from warp_ar.accuracy.metrics import changed_region, flip_map
from warp_ar.accuracy.pictures import sheet
from warp_ar.output.environment_file import write_environment
from warp_ar.output.shot import Shot
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import load_scene

MARGIN = 16
"""Pixels around what is compared that are rendered and shown as well."""
SMALLER = 4
"""Times as small is the picture by which reflectance is found."""


def region_box(region: Any) -> tuple[slice, slice]:
    """Rows and columns around a region."""
    ends = []
    for axis in (1, 0):
        found = np.flatnonzero(region.any(axis=axis))
        ends.append(slice(max(found[0] - MARGIN, 0), min(found[-1] + 1 + MARGIN, region.shape[1 - axis])))
    return ends[0], ends[1]


def write_work(work: Path, known: KnownFrame, box: tuple[slice, slice], samples: int) -> None:
    """What Blender is told."""
    camera = known.scene.camera
    write_environment(work / "shot_environment.exr", known.light.radiance, axes="y-up")
    scene = dataclasses.replace(known.scene, lights=())
    write_usd(work / "shot.usda", Shot(scene, 24.0, (known.pose,), environment=work / "shot_environment.exr"))
    tracer = known.tracer(size=(camera.width // SMALLER, camera.height // SMALLER), device="cpu")
    tracer.prepare()
    np.savez(
        work / "asked.npz",
        reflectances=tracer._local.proxy_reflectance.numpy(),
        size=(camera.width, camera.height),
        samples=samples,
        rows=(box[0].start, box[0].stop),
        columns=(box[1].start, box[1].stop),
    )


def compare(case: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One case; its pictures go to the folder ``--out``."""
    scene = load_scene(case / "scene_object.toml")
    truth = truth_of(scene, options.frame)
    assert truth is not None, f"{case} has no truth of frame {options.frame}"
    known = light_up_to(scene, options.frame, quality=options.quality, device="cpu")
    region = changed_region(known.image, truth)
    box = region_box(region)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        write_work(work, known, box, options.samples)
        command = [options.blender, str(Path(__file__).with_name("render_in_blender.py")), folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with OpenEXR.File(str(work / "render.exr"), separate_channels=True) as file:
            layers = {name: np.array(file.channels()[name].pixels) for name in "RGBA"}
        seconds = float(np.load(work / "seconds.npy"))
    plate = decoded(known.image, known)
    over = np.stack([layers[name] for name in "RGB"], axis=-1) + (1.0 - layers["A"][..., None]) * plate
    cycles = known.image.copy()
    cycles[box] = encoded(over.astype(np.float32), known)[box]
    nothing = float(flip_map(truth, known.image)[region].mean())
    kept = {
        name: round(float(flip_map(truth, image)[region].mean()) / nothing, 3)
        for name, image in (("cycles", cycles), (options.quality, known.lit))
    }
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        picture = sheet([known.image, cycles, known.lit, truth], truth, box)
        cv2.imwrite(str(options.out / f"{case.name}.webp"), picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 85])
    about = {"case": case.name, "frame": options.frame, "samples": options.samples, "quality": options.quality}
    return {**about, "kept": kept, "seconds": round(seconds, 1), "commit": commit()}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.beside_cycles", description="Cycles beside the pipeline.")
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE")
    parser.add_argument("--blender", required=True, metavar="PYTHON", help="an interpreter with bpy")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--quality", default="high")
    parser.add_argument("--out", type=Path, metavar="DIR", help="camera, Cycles, ours, truth, side by side")
    options = parser.parse_args()
    for case in options.cases:
        print(json.dumps(compare(case, options)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
