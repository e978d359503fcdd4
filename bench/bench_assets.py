"""Mesh files as we, Mitsuba's path tracer and three.js show them under one environment: FLIP to the path tracer.

``python -m bench assets --models DIR --three PACKAGE --output PAGE``: every glTF file of a folder, rendered in a fixed
environment made from a picture of the repository, by the same camera, before a grey background. Needs the packages
mitsuba and playwright, Chromium, and the npm package three, unpacked. The page shows the pictures side by side; one
JSON line per file, then the means.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import html
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.metrics import flip_map
from warp_ar.errors import SceneError, WarpArError
from warp_ar.output.environment_file import write_environment
from warp_ar.pictures import read_picture
from warp_ar.scene import Camera, CapturedLight, Object, Pose, Scene
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.srgb import decode_srgb, encode_srgb

Array = npt.NDArray[Any]

PICTURE = Path(__file__).parents[1] / "docs" / "photograph.jpg"
GREY = 96
"""Code of the background."""
FIELD = 30.0
"""Field of view in degrees."""
TOWARD = np.array([0.55, -0.78, 0.30])
"""From the model to the camera."""
RADIUS = 0.1
"""To which models are scaled, in metres."""
MEMBERS = ("ours", "three")


def make_environment(height: int = 128) -> Array:
    """Latlong radiance from the picture and its mirror image, its highlights drawn out to 8 times white."""
    picture = read_picture(PICTURE, cv2.IMREAD_COLOR_RGB, SceneError, f"{PICTURE}")
    small = cv2.resize(picture, (height, height), interpolation=cv2.INTER_AREA)
    linear = decode_srgb(small / 255.0)
    bright = linear / (1.125 - linear)
    return np.ascontiguousarray(np.concatenate([bright, bright[:, ::-1]], axis=1), np.float32)


def turned_to(eye: Array, center: Array) -> Pose:
    """Camera at ``eye`` that looks at ``center``, its x axis level."""
    forward = (center - eye) / np.linalg.norm(center - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Pose(rotation, -rotation @ eye)


@dataclasses.dataclass(frozen=True)
class View:
    """How a model is looked at."""

    camera: Camera
    pose: Pose
    scale: float
    at: Array
    """Where the mesh's origin goes, so that its middle is at the world's."""
    page: dict[str, Any]
    """The same for three.js, in the file's own axes."""


def view_of(mesh: Mesh, size: int) -> View:
    """A camera that sees all of a mesh."""
    used = mesh.vertices[np.unique(mesh.faces)].astype(float)
    center = 0.5 * (used.min(axis=0) + used.max(axis=0))
    radius = float(np.linalg.norm(used - center, axis=1).max())
    toward = TOWARD / np.linalg.norm(TOWARD)
    distance = RADIUS / np.sin(np.radians(0.5 * FIELD)) * 0.95
    camera = Camera.guessed(size, size, FIELD, "srgb")
    scale = RADIUS / radius
    eye = center + toward * distance / scale
    to_file = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    page = {
        "size": size,
        "fov": FIELD,
        "eye": (to_file @ eye).tolist(),
        "center": (to_file @ center).tolist(),
        "near": 0.05 * distance / scale,
        "far": 4.0 * distance / scale,
        "background": [GREY / 255.0] * 3,
    }
    return View(camera, turned_to(distance * toward, np.zeros(3)), scale, -scale * center, page)


def ours(path: Path, view: View, light: Path, quality: str, device: str) -> Array:
    """Our picture, RGB of 8 bits."""
    from warp_ar.engine.pipeline import Pipeline

    x, y, z = map(float, view.at)
    scene = Scene(
        view.camera,
        objects=(Object("mesh", file=path, at=(x, y, z), scale=view.scale),),
        captured=CapturedLight(light),
        has_marker=False,
    )
    size = view.camera.width
    with contextlib.closing(Pipeline(scene, device=device, quality=quality)) as pipeline:
        frame = np.full((size, size, 3), GREY, np.uint8)
        return np.array(pipeline(frame, time_seconds=0.0, pose=view.pose).image)


def traced(mesh: Mesh, view: View, radiance: Array, samples: int) -> tuple[Array, Array]:
    """Mitsuba's picture, RGB of 8 bits, and where the model is."""
    from bench.assets_mitsuba import render_mitsuba

    vertices = (mesh.vertices.astype(float) * view.scale + view.at).astype(np.float32)
    placed = dataclasses.replace(mesh, vertices=vertices)
    linear, cover = render_mitsuba(placed, view.camera, view.pose, radiance, samples)
    grey = decode_srgb(np.array(GREY / 255.0))
    picture = encode_srgb(np.clip(linear + (1.0 - cover[..., None]) * grey, 0.0, 1.0))
    return np.rint(255.0 * picture).astype(np.uint8), cover > 0.0


def find_models(folder: Path) -> list[Path]:
    """GlTF files of a folder and those in it, by name."""
    return sorted(path for suffix in ("glb", "gltf") for path in folder.rglob(f"*.{suffix}"))


def main(device: str, arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench assets")
    parser.add_argument("--models", type=Path, required=True, metavar="DIR", help="a folder of glTF files")
    parser.add_argument("--three", type=Path, required=True, metavar="PACKAGE", help="the npm package three, unpacked")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="PAGE", help="folder of the page and its pictures"
    )
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--quality", default="medium")
    parser.add_argument("--variant", default="scalar_rgb", help="Mitsuba's; llvm_ad_rgb is quicker for many samples")
    parser.add_argument("--only", default="", help="names, separated by commas")
    options = parser.parse_args(arguments)
    import mitsuba as mi

    from bench.assets_three import ThreePage

    mi.set_variant(options.variant)  # scalar_rgb compiles nothing: each file has materials of its own
    options.output.mkdir(parents=True, exist_ok=True)
    radiance = make_environment()
    light = options.output / "environment.exr"
    write_environment(light, radiance, overwrite=True)
    lines = []
    with (
        tempfile.TemporaryDirectory() as work,
        ThreePage(options.three, options.models, Path(work), radiance) as page,
    ):
        for path in find_models(options.models):
            if options.only and path.stem not in options.only.split(","):
                continue
            line = _compare(path, options, radiance, light, page, device)
            print(json.dumps(line), flush=True)
            lines.append(line)
            _write_page(options.output, lines)
    whole = [line for line in lines if "ours" in line]
    means = {name: round(float(np.mean([line[name] for line in whole])), 4) for name in MEMBERS} if whole else {}
    print(json.dumps({"models": len(whole), **means, "samples": options.samples, "quality": options.quality}))


def _compare(path: Path, options: Any, radiance: Array, light: Path, page: Any, device: str) -> dict[str, Any]:
    name = path.stem if path.suffix == ".glb" else path.parent.name
    try:
        mesh = load_mesh(path)
        view = view_of(mesh, options.size)
        truth, there = traced(mesh, view, radiance, options.samples)
        pictures = {
            "ours": ours(path, view, light, options.quality, device),
            "three": page.render(path.relative_to(options.models).as_posix(), view.page),
        }
    except (WarpArError, TypeError) as error:
        return {"model": name, "left out": str(error)[-160:]}
    line: dict[str, Any] = {"model": name, "triangles": len(mesh.faces)}
    for member, picture in pictures.items():
        region = there | (np.abs(picture.astype(int) - GREY) > 2).any(axis=-1)
        line[member] = round(float(flip_map(truth, picture)[region].mean()), 4)
    for member, picture in {"mitsuba": truth, **pictures}.items():
        cv2.imwrite(str(options.output / f"{name}_{member}.png"), picture[..., ::-1])
    return line


def _write_page(folder: Path, lines: list[dict[str, Any]]) -> None:
    rows = []
    for line in lines:
        name = html.escape(line["model"])
        if "ours" not in line:
            rows.append(f"<h2>{name}</h2><p>{html.escape(line['left out'])}</p>")
            continue
        cells = "".join(
            f"<figure><img src='{name}_{member}.png'><figcaption>{member} {line.get(member, '')}</figcaption></figure>"
            for member in ("ours", "mitsuba", "three")
        )
        rows.append(f"<h2>{name}</h2><div>{cells}</div>")
    style = "<style>figure{display:inline-block;margin:4px}body{font-family:sans-serif}</style>"
    (folder / "index.html").write_text(f"<!doctype html><meta charset=utf-8>{style}{''.join(rows)}")
