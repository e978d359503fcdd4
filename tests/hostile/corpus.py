"""Real files, one for each format that is read, small, and the same in every run."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import OpenEXR

from warp_ar.farm.jobs import parse_jobs, read_jobs
from warp_ar.farm.manifest import read_status, status_lines
from warp_ar.kernels.color import decode_table
from warp_ar.light.captured import Light, find_emitters
from warp_ar.output.camera_files import write_track
from warp_ar.output.environment_file import read_environment, write_environment
from warp_ar.output.shot import Shot
from warp_ar.output.sinks import open_sink
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import Pose, load_calibration, load_scene, loads_scene
from warp_ar.scene.exif import read_exif
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.pose_file import load_pose_file
from warp_ar.scene.shapes import torus_mesh
from warp_ar.scene.textures import load_texture
from warp_ar.sources.frame_folder import FrameFolder
from warp_ar.sources.sources import open_source

SCENE = """schema = 1
name = "small"
[camera]
width = 64
height = 48
fx = 60.0
fy = 60.0
cx = 31.5
cy = 23.5
[source]
synthetic = "card"
[marker]
size = 0.08
[probe]
center = [-0.1, 0.03, 0.03]
radius = 0.03
[[object]]
shape = "torus"
major_radius = 0.03
minor_radius = 0.01
at = [0.1, 0.0, 0.03]
[object.material]
model = "metallic_roughness"
base_color = [0.5, 0.5, 0.5]
[[light]]
kind = "point"
intensity = 0.5
at = [0.0, 0.0, 0.5]
"""
CALIBRATION = {"image_width": 64, "image_height": 48, "camera_matrix": [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]}


@dataclasses.dataclass(frozen=True)
class Reader:
    """A way in: a file that is read, and by what."""

    name: str
    """In the table."""
    file: str
    """Name of the file, in a folder of its own."""
    read: Callable[[pathlib.Path], object]
    """Reads all of it."""
    make: Callable[[pathlib.Path], object]
    """Writes a sound one, and what it names beside it."""


def _frames(path: pathlib.Path) -> int:
    with open_source(path) as source:
        return sum(frame.image.size for frame in source)


def _beside(path: pathlib.Path) -> int:
    with FrameFolder(path.parent) as source:
        return sum(frame.image.size for frame in source)


def picture(size: tuple[int, int] = (24, 16)) -> np.ndarray:
    y, x = np.mgrid[: size[1], : size[0]]
    return np.stack([10 * x, 15 * y, 5 * (x + y)], axis=-1).astype(np.uint8)


def _image(path: pathlib.Path) -> None:
    assert cv2.imwrite(str(path), picture())


def _photograph(path: pathlib.Path) -> None:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0110] = "A camera"
    exif[0x0112] = 6
    inner = exif.get_ifd(0x8769)
    inner.update({0x829A: (1, 125), 0x829D: (28, 10), 0x8827: 200, 0xA405: 28, 0x920A: (43, 10)})
    Image.fromarray(picture()).save(path, exif=exif)


def _video(path: pathlib.Path) -> None:
    with open_sink(path, fps=24) as sink:
        for index in range(14):
            sink.write(np.roll(picture((32, 32)), index, axis=1))


def _calibration(path: pathlib.Path) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("camera_matrix", np.array(CALIBRATION["camera_matrix"], float))
    storage.write("distortion_coefficients", np.zeros((1, 5)))
    storage.release()


def _trimesh() -> Any:
    import trimesh
    from PIL import Image

    mesh = torus_mesh(0.03, 0.01, 0.004)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture()))
    visual = trimesh.visual.TextureVisuals(uv=mesh.uvs, material=material)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False)


def _mesh(path: pathlib.Path) -> None:
    mesh = _trimesh()
    kind = path.suffix[1:]
    if kind == "gltf":
        for name, data in mesh.export(file_type="gltf").items():
            (path if name == "model.gltf" else path.parent / name).write_bytes(data)
    elif kind == "obj":
        path.write_text(mesh.export(file_type="obj", include_texture=False, mtl_name="m.mtl"))
        text = path.read_text()
        path.write_text("mtllib m.mtl\nusemtl m\n" + text if "mtllib" not in text else text)
        (path.parent / "m.mtl").write_text("newmtl m\nmap_Kd wood.png\n")
        _image(path.parent / "wood.png")
    else:
        path.write_bytes(mesh.export(file_type=kind) if kind != "off" else mesh.export(file_type=kind).encode())


def _sidecar(path: pathlib.Path) -> None:
    for index in range(3):
        _image(path.parent / f"{index}.png")
    path.write_text(json.dumps({"0.png": 0.01, "1.png": 0.002}))


def _deep_frames(path: pathlib.Path) -> int:
    with open_source(path) as source:
        source.keeps_depth = True
        return sum(frame.image.size for frame in source)


def _deep_picture(path: pathlib.Path) -> None:
    light = picture().astype(np.float32) / 64.0
    if path.suffix == ".exr":
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": light}).write(str(path))
    else:
        assert cv2.imwrite(str(path), (light * 4096.0).astype(np.uint16))


def _deep_video(path: pathlib.Path) -> None:
    with open_sink(path, fps=24, coding="10bit") as sink:
        for index in range(4):
            sink.write(np.roll(picture((32, 32)), index, axis=1).astype(np.float32) / 255.0)


def _shot() -> Shot:
    poses = tuple(Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5 + 0.01 * k])) for k in range(3))
    return Shot(loads_scene(SCENE), 24.0, poses)


def _track(path: pathlib.Path) -> None:
    write_track(path, _shot())


def _binary_poses(path: pathlib.Path) -> None:
    image = struct.pack("<I7dI", 1, 0.7, 0.0, 0.0, 0.7, 0.1, 0.2, 1.0, 1)
    path.write_bytes(struct.pack("<Q", 2) + 2 * (image + b"a.png\0" + struct.pack("<Q2dq", 1, 10.0, 20.0, -1)))


def _binary_cameras(path: pathlib.Path) -> None:
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 60.0, 60.0, 32.0, 24.0))


def _jobs(path: pathlib.Path) -> None:
    clip = '[[clip]]\nscene = "desk"\nframes = [0, 30]\n'
    path.write_text(f'schema = 1\n[run]\nquality = "low"\nsegment_frames = 20\n{clip}')


def _status(path: pathlib.Path) -> object:
    """What ``farm status`` says."""
    folder = path.parent
    return status_lines(folder, read_status(folder))


def _run(path: pathlib.Path) -> None:
    """A run of two jobs, one of which has failed."""
    folder = path.parent
    (folder / "run.json").write_text(json.dumps({"version": "1", "jobs": {"clip": [{"scene": "desk"}]}}))
    lines: list[dict[str, object]] = [
        {"state": "done", "job": "desk/segment-0", "frames": 20, "bytes": 4096, "seconds": 1.5, "worker": 0},
        {"state": "failed", "job": "desk/segment-1", "reason": "no frame"},
    ]
    (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def _response(path: pathlib.Path) -> None:
    path.write_text("".join(f"{v:.6g} {v:.6g} {v:.6g}\n" for v in np.linspace(0, 1, 256)))


def _environment(path: pathlib.Path) -> None:
    write_environment(path, picture().astype(np.float32))


def _poses(path: pathlib.Path) -> None:
    turned = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    if path.suffix == ".json":
        path.write_text(json.dumps([{"R": turned, "t": [0.1, 0.2, 1.0 + 0.1 * k]} for k in range(3)]))
    else:
        lines = [f"{k} 0.707 0.0 0.0 0.707 0.1 0.2 1.{k} 1 {k}.png\n10.5 20.5 -1\n" for k in range(3)]
        path.write_text("# Image list\n" + "".join(lines))


def _light(path: pathlib.Path) -> None:
    radiance = np.full((8, 16, 3), 0.25, np.float32)
    radiance[1, 3] = 50.0
    emitters = find_emitters(radiance, (radiance > 1.0).astype(np.float32), 0.1)
    Light(radiance, np.ones((8, 16), np.float32), emitters, 0.9, 0.01, 0.2).save(path)


def _material(path: pathlib.Path) -> None:
    _mesh(path.parent / "a.obj")


def _buffer(path: pathlib.Path) -> None:
    """The first file that a glTF names, under a name of its own."""
    _mesh(path.parent / "a.gltf")
    text = (path.parent / "a.gltf").read_text()
    name = json.loads(text)["buffers"][0]["uri"]
    (path.parent / name).rename(path)
    (path.parent / "a.gltf").write_text(text.replace(name, path.name))


def _texture_of_gltf(path: pathlib.Path) -> None:
    _mesh(path.parent / "a.gltf")
    tree = json.loads((path.parent / "a.gltf").read_text())
    tree["images"] = [{"uri": path.name}]
    (path.parent / "a.gltf").write_text(json.dumps(tree))
    _image(path)


READERS = (
    *(Reader(f"frame, {kind.upper()}", f"a.{kind}", _frames, _image) for kind in ("png", "jpg", "bmp", "tiff", "webp")),
    *(Reader(f"video, {kind.upper()}", f"a.{kind}", _frames, _video) for kind in ("mp4", "mov", "mkv")),
    Reader("exposures.json", "exposures.json", _beside, _sidecar),
    Reader("scene, TOML", "scene.toml", load_scene, lambda path: path.write_text(SCENE)),
    *(
        Reader(f"calibration, {kind.upper()}", f"camera.{kind}", load_calibration, _calibration)
        for kind in ("yml", "json", "xml")
    ),
    Reader("frame of light, EXR", "a.exr", _deep_frames, _deep_picture),
    Reader("frame of 16 bits, PNG", "a.png", _deep_frames, _deep_picture),
    Reader("frame of 16 bits, TIFF", "a.tif", _deep_frames, _deep_picture),
    Reader("video of 10 bits, MOV", "a.mov", _deep_frames, _deep_video),
    Reader("response", "response.txt", decode_table, _response),
    Reader("texture", "a.png", load_texture, _image),
    *(Reader(f"mesh, {kind.upper()}", f"a.{kind}", load_mesh, _mesh) for kind in ("ply", "obj", "stl", "off")),
    Reader("mesh, GLB", "a.glb", load_mesh, _mesh),
    Reader("mesh, glTF", "a.gltf", load_mesh, _mesh),
    Reader("OBJ's materials", "m.mtl", lambda path: load_mesh(path.parent / "a.obj"), _material),
    Reader("OBJ's texture", "wood.png", lambda path: load_mesh(path.parent / "a.obj"), _material),
    Reader("glTF's buffer", "a.bin", lambda path: load_mesh(path.parent / "a.gltf"), _buffer),
    Reader("glTF's texture", "a.png", lambda path: load_mesh(path.parent / "a.gltf"), _texture_of_gltf),
    Reader("photograph with EXIF", "a.jpg", read_exif, _photograph),
    Reader("photograph with EXIF, TIFF", "a.tiff", read_exif, _photograph),
    Reader("environment, EXR", "a.exr", read_environment, _environment),
    Reader("captured light, EXR", "light.exr", Light.load, _light),
    Reader("poses, JSON", "poses.json", load_pose_file, _poses),
    Reader("poses, COLMAP", "images.txt", load_pose_file, _poses),
    Reader("poses, COLMAP's binary", "images.bin", load_pose_file, _binary_poses),
    Reader("calibration, COLMAP's binary", "cameras.bin", load_calibration, _binary_cameras),
    Reader("poses, OpenTrackIO", "track.jsonl", load_pose_file, _track),
    Reader("poses, USD", "shot.usda", load_pose_file, lambda path: write_usd(path, _shot())),
    Reader("farm's jobs, TOML", "jobs.toml", lambda path: parse_jobs(read_jobs(path), str(path)), _jobs),
    Reader("farm's run, run.json", "run.json", _status, _run),
    Reader("farm's run, manifest", "manifest.jsonl", _status, _run),
)
