"""What is tried: real files damaged at random, things that are no files, and files made to hurt."""

from __future__ import annotations

import base64
import json
import os
import pathlib
import random
import socket
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from tests.hostile.corpus import READERS, SCENE, Reader
from warp_ar.accuracy.path_tracer import TracedPicture
from warp_ar.errors import SinkError
from warp_ar.light.captured import Light
from warp_ar.output.camera_files import write_stmap, write_track
from warp_ar.output.environment_file import write_environment
from warp_ar.output.gltf_file import write_glb
from warp_ar.output.layer_file import LayerFrame, LayerSink
from warp_ar.output.places import check_replaceable
from warp_ar.output.shot import Shot
from warp_ar.output.sink import Sink, make_folder
from warp_ar.output.sinks import EnvironmentSink, open_sink
from warp_ar.output.usd_file import write_usd
from warp_ar.reference import write_picture
from warp_ar.scene import Pose, loads_scene
from warp_ar.sources.sources import open_source

DAMAGES = 40
"""Damaged copies of each file."""


SOUND = "nothing: it is sound"
"""Every reader reads such a one, else the others would say nothing."""


class Case(NamedTuple):
    """One input."""

    row: str
    """Where it stands in the table."""
    what: str
    """What is wrong."""
    prepare: Callable[[pathlib.Path], Callable[[], object]]
    """Makes it in an empty folder, and returns what takes it in."""


def damaged(data: bytes, number: int) -> bytes:
    """A copy with one to three damages of the kinds that files suffer, and that readers trip over.

    What is text stays text: a byte that is none would be all that its reader sees.
    """
    chance = random.Random(number)
    text = data.isascii() and b"\0" not in data
    noise = (lambda n: bytes(chance.choices(range(32, 127), k=n))) if text else chance.randbytes
    result = bytearray(data)
    for _ in range(chance.randint(1, 3)):
        at = chance.randrange(max(len(result), 1))
        # Headers decide most: a third of all damages are there.
        at = min(at, chance.randrange(96)) if chance.random() < 0.33 else at
        length = chance.choice((1, 2, 4, 8, 64))
        kind = chance.randrange(8)
        if kind == 0:
            del result[at:]
        elif kind == 1:
            del result[at : at + length]
        elif kind == 2:
            result[at:at] = noise(length)
        elif kind == 3:
            result[at : at + length] = noise(length)
        elif kind == 4:
            extreme = chance.choice((0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x00FFFFFF, 60000))
            packed = str(extreme).encode() if text else struct.pack(chance.choice("<>") + "I", extreme)
            result[at : at + len(packed)] = packed
        elif kind == 5:
            result[at:at] = result[at : at + length * 16]
        elif kind == 6 and result:
            at = min(at, len(result) - 1)
            result[at] = noise(1)[0] if text else result[at] ^ 1 << chance.randrange(8)
        else:
            zeros = b"0" * length if text else b"\0" * length
            result[at:at] = chance.choice((zeros, b"9" * length, b"[" * length, b'"', b"-", b"\n", b"1e999 "))
    return bytes(result)


def _sound(reader: Reader) -> Case:
    def prepare(folder: pathlib.Path) -> Callable[[], object]:
        path = folder / reader.file
        reader.make(path)
        return lambda: reader.read(path)

    return Case(reader.name, SOUND, prepare)


def _damage(reader: Reader, number: int) -> Case:
    def prepare(folder: pathlib.Path) -> Callable[[], object]:
        path = folder / reader.file
        reader.make(path)
        path.write_bytes(damaged(path.read_bytes(), number))
        return lambda: reader.read(path)

    return Case(reader.name, f"damage {number}", prepare)


def _sparse(path: pathlib.Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(8 << 30)


def _socket(path: pathlib.Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        here = os.getcwd()
        os.chdir(path.parent)  # a socket's path is at most 108 bytes long
        server.bind(path.name)
        os.chdir(here)


NO_FILES: dict[str, Callable[[pathlib.Path], object]] = {
    "a named pipe": os.mkfifo,
    "a device without end": lambda path: path.symlink_to("/dev/zero"),
    "a terminal": lambda path: path.symlink_to("/dev/tty"),
    "a socket": _socket,
    "a folder": pathlib.Path.mkdir,
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "no bytes": lambda path: path.write_bytes(b""),
    "8 GiB of nothing": _sparse,
    "zeros": lambda path: path.write_bytes(bytes(4096)),
    "noise": lambda path: path.write_bytes(random.Random(0).randbytes(4096)),
    "another format": lambda path: path.write_bytes(b"GIF89a" + b"\xff\xff" * 3 + bytes(64)),
}


def _no_file(reader: Reader, what: str) -> Case:
    def prepare(folder: pathlib.Path) -> Callable[[], object]:
        path = folder / reader.file
        reader.make(path)
        path.unlink()
        NO_FILES[what](path)
        return lambda: reader.read(path)

    return Case(reader.name, what, prepare)


NAMES = {
    "a name of 5,000 characters": "x" * 5000,
    "a folder of 5,000 characters": "x" * 5000 + "/a.png",
    "a zero byte": "a\0b",
    "half a pair": "a\ud800",
    "a terminal's commands": "\x1b[2J\x1b]0;owned\x07",
    "a number of 20 digits": "9" * 20,
    "a number of 5,000 digits": "9" * 5000,
    "index 1024": "1024",
    "an unknown clip": "synthetic:" + "x" * 300,
    "nothing": "nothing",
}


def png(width: int, height: int, body: bytes = b"") -> bytes:
    """A PNG whose header promises that many pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(body or bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def _jpeg(width: int, height: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height, width, 3) + bytes([1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1])
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def _tiff(width: int, height: int, tile: int = 0) -> bytes:
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1), (262, 3, 2), (277, 3, 3)]
    tags += [(322, 4, tile), (323, 4, tile), (324, 4, 8), (325, 4, 100)] if tile else [(273, 4, 8), (279, 4, 100)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in sorted(tags))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(104)


def _bmp(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 1000, 0, 54, 40, width, height, 1, 24, 0, 0, 1, 1, 0, 0) + bytes(100)


def _exr(width: int, height: int) -> bytes:
    def attribute(name: bytes, kind: bytes, data: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<I", len(data)) + data

    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    channels = b"".join(name + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) for name in (b"B", b"G", b"R"))
    return (
        b"\x76\x2f\x31\x01\x02\0\0\0"
        + attribute(b"channels", b"chlist", channels + b"\0")
        + attribute(b"compression", b"compression", b"\0")
        + attribute(b"dataWindow", b"box2i", window)
        + attribute(b"displayWindow", b"box2i", window)
        + attribute(b"lineOrder", b"lineOrder", b"\0")
        + attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1.0))
        + attribute(b"screenWindowCenter", b"v2f", struct.pack("<ff", 0, 0))
        + attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1.0))
        + b"\0"
        + bytes(100)
    )


def _nested(kind: str, depth: int) -> bytes:
    if kind == "yml":
        return b"%YAML:1.0\ncamera_matrix: " + b"[" * depth + b"]" * depth
    if kind == "block.yml":
        return b"%YAML:1.0\n" + b"".join(b" " * level + b"a:\n" for level in range(min(depth, 2500)))
    if kind == "dashes.yml":
        return b"%YAML:1.0\na:\n  " + b"- " * depth + b"1\n"
    if kind == "json":
        return b'{"camera_matrix": ' + b"[" * depth + b"]" * depth + b"}"
    if kind == "maps.json":
        return b'{"a": ' * depth + b"1" + b"}" * depth
    return b"<?xml version='1.0'?><opencv_storage>" + b"<a>" * depth + b"</a>" * depth + b"</opencv_storage>"


def _gltf(**changes: object) -> bytes:
    data = base64.b64encode(np.zeros((3, 3), np.float32).tobytes()).decode()
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "data:image/png;base64," + base64.b64encode(png(2, 2)).decode()}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "data:;base64," + data, "byteLength": 36}],
    }
    return json.dumps({**tree, **changes}).encode()


def _bomb(width: int) -> str:
    return "data:image/png;base64," + base64.b64encode(png(width, width, bytes(10_000_000))).decode()


def _toml(text: str) -> bytes:
    return (SCENE + text).encode()


# Reader's file, what is in it.
MADE_TO_HURT: dict[tuple[str, str], bytes] = {
    **{
        (f"frame, {kind}", f"{side}x{side}"): make(side, side)
        for side in (30000, 60000, 65535)
        for kind, make in (("PNG", png), ("JPG", _jpeg), ("TIFF", _tiff), ("BMP", _bmp))
    },
    ("frame, TIFF", "a tile of 16 million pixels a side"): _tiff(16, 16, 1 << 24),
    ("frame, TIFF", "a tile of 16384 pixels a side"): _tiff(16, 16, 1 << 14),
    ("frame, PNG", "no pixel"): png(0, 0),
    ("frame, PNG", "2147483647 pixels a side"): png(0x7FFFFFFF, 0x7FFFFFFF),
    ("frame, BMP", "a height below 0"): _bmp(60000, -60000),
    ("frame, JPG", "a PNG of 60000 pixels a side under another name"): png(60000, 60000),
    ("texture", "60000x60000"): png(60000, 60000),
    ("texture", "10 million bytes in one row"): png(16, 16, bytes(10_000_000)),
    ("OBJ's texture", "60000x60000"): png(60000, 60000),
    ("glTF's texture", "60000x60000"): png(60000, 60000),
    ("environment, EXR", "60000x60000"): _exr(60000, 60000),
    ("environment, EXR", "2147483647 pixels a side"): _exr(0x7FFFFFFF, 0x7FFFFFFF),
    ("environment, EXR", "a size below 0"): _exr(-5, -5),
    ("video, MP4", "SVG"): b'<svg xmlns="http://www.w3.org/2000/svg" width="64" height="64"><rect width="9"/></svg>',
    ("video, MP4", "text"): b"This is not a video. " * 100,
    ("video, MP4", "a list of files"): b"ffconcat version 1.0\nfile /dev/zero\n",
    ("video, MP4", "a play list"): b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n/dev/zero\n#EXT-X-ENDLIST\n",
    ("video, MP4", "an address"): b"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nhttp://192.0.2.1/a.ts\n",
    ("exposures.json", "3,000 deep"): b"[" * 3000,
    ("exposures.json", "200,000 deep"): b"[" * 200_000 + b"]" * 200_000,
    ("exposures.json", "objects, 200,000 deep"): b'{"a":' * 200_000 + b"1" + b"}" * 200_000,
    ("exposures.json", "a number of 10,000 digits"): b"[" + b"9" * 10_000 + b", 1]",
    ("exposures.json", "infinity"): b"[Infinity, NaN]",
    **{
        (f"calibration, {kind.split('.')[-1].upper()}", f"{kind}, {depth:,} deep"): _nested(kind, depth)
        for kind in ("yml", "block.yml", "dashes.yml", "json", "maps.json", "xml")
        for depth in (100, 3000, 200_000)
    },
    ("scene, TOML", "2,000 dotted keys of 500 parts"): _toml("".join(f"k{i}{'.a' * 499} = 1\n" for i in range(2000))),
    ("scene, TOML", "a section of 5,000 parts"): _toml("[a" + ".a" * 4999 + "]\n"),
    ("scene, TOML", "an inline table of 5,000 parts"): _toml("x = {a" + ".a" * 4999 + " = 1}\n"),
    ("scene, TOML", "quoted keys of 500 parts"): _toml("".join(f'"k{i}"{".a" * 499} = 1\n' for i in range(2000))),
    ("scene, TOML", "arrays, 200,000 deep"): _toml("x = " + "[" * 200_000),
    ("scene, TOML", "tables, 5,000 deep"): _toml("x = " + "{a=" * 5000 + "1" + "}" * 5000),
    ("scene, TOML", "20,000 sections"): _toml("".join(f"[s{i}]\n" for i in range(20_000))),
    ("scene, TOML", "a number of 5,000 digits"): _toml("[exposure]\nscale = " + "9" * 5000),
    ("scene, TOML", "a terminal's commands"): _toml('"\\u001b[2J" = 1'),
    ("scene, TOML", "an octal of a million digits"): _toml("x = 0x" + "f" * 1_000_000),
    ("frame of light, EXR", "60000x60000"): _exr(60000, 60000),
    ("frame of light, EXR", "a size below 0"): _exr(-5, -5),
    ("frame of 16 bits, PNG", "60000x60000"): png(60000, 60000),
    ("frame of 16 bits, TIFF", "60000x60000"): _tiff(60000, 60000),
    ("video of 10 bits, MOV", "text"): b"This is not a video. " * 100,
    ("poses, COLMAP's binary", "2^63 images"): struct.pack("<Q", 1 << 63),
    ("poses, COLMAP's binary", "an image of 2^60 points"): struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1)
    + b"a\0"
    + struct.pack("<Q", 1 << 60),
    ("poses, OpenTrackIO", "200,000 deep"): b'{"transforms":' * 200_000,
    ("poses, OpenTrackIO", "an angle of 5,000 digits"): b'{"transforms":[{"translation":{"x":' + b"9" * 5000 + b"}}]}",
    **{
        ("poses, USD", what): b"#usda 1.0\n" + text
        for what, text in {
            "a layer from a device": b"( subLayers = [@/dev/zero@] )\n",
            "a layer that is itself": b"( subLayers = [@shot.usda@] )\n",
            "a reference to itself": b'def Xform "a" ( references = @shot.usda@</a> ) { }\n',
            "a million frames and one": b'( startTimeCode = 0 endTimeCode = 1000001 )\ndef Camera "c" { }\n',
            "a time of 10^300": b'( startTimeCode = 0 endTimeCode = 1e300 )\ndef Camera "c" { }\n',
            "5,000 deep": b"".join(b'def Xform "a" {\n' for _ in range(5000)) + b"}\n" * 5000,
            "a layer on another machine": b"( subLayers = [@https://a.example/a.usda@] )\n",
        }.items()
    },
    ("farm's jobs, TOML", "arrays, 200,000 deep"): b"schema = " + b"[" * 200_000,
    ("farm's jobs, TOML", "a pattern of all files"): b'schema = 1\n[[clip]]\nscene = "desk"\npath = "/proc/*/fd/*"\n',
    ("farm's jobs, TOML", "clips that are no tables"): b"schema = 1\nclip = [1, 2]\n",
    ("farm's jobs, TOML", "a frame of 5,000 digits"): b'schema = 1\n[[clip]]\nscene = "desk"\nframes = [0, '
    + b"9" * 5000
    + b"]",
    ("farm's run, run.json", "200,000 deep"): b"[" * 200_000,
    ("farm's run, run.json", "jobs that are a list"): b'{"version": "1", "jobs": [1]}',
    ("farm's run, manifest", "200,000 deep"): b"[" * 200_000 + b"\n",
    ("farm's run, manifest", "a key that is a list"): b'{"state": "done", "job": ["a/b"]}\n',
    ("farm's run, manifest", "frames that are text"): b'{"state": "done", "job": "a/b-1", "frames": "many"}\n',
    ("response", "a million numbers"): b"0.5 " * 1_000_000,
    ("response", "a line of a million digits"): b"9" * 1_000_000,
    ("response", "not a number"): b"nan nan nan\n" * 256,
    (
        "mesh, PLY",
        "10^12 vertices",
    ): b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n",
    ("mesh, PLY", "4 billion faces"): b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
    b"property float y\nproperty float z\nelement face 4000000000\nproperty list uchar int vertex_indices\nend_header\n"
    + bytes(100),
    ("mesh, STL", "4 billion triangles"): bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(100),
    ("mesh, OFF", "10^12 vertices"): b"OFF\n1000000000000 1000000000000 0\n0 0 0\n",
    ("mesh, OBJ", "a face of index 10^18"): b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000000000000\n",
    ("mesh, OBJ", "materials from a device"): b"mtllib /dev/zero\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    (
        "mesh, OBJ",
        "materials from below the root",
    ): b"mtllib ../../../../dev/zero\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    ("OBJ's materials", "a texture from a device"): b"newmtl m\nmap_Kd /dev/zero\n",
    ("OBJ's materials", "a texture of 5,000 characters"): b"newmtl m\nmap_Kd " + b"x" * 5000,
    ("mesh, glTF", "a missing texture"): _gltf(images=[{"uri": "none.png"}]),
    ("mesh, glTF", "a texture from a device"): _gltf(images=[{"uri": "/dev/zero"}]),
    ("mesh, glTF", "a texture of 60000x60000"): _gltf(images=[{"uri": _bomb(60000)}]),
    ("mesh, glTF", "a texture of 16000x16000"): _gltf(images=[{"uri": _bomb(16000)}]),
    ("mesh, glTF", "a texture that is text"): _gltf(images=[{"uri": "data:;base64,aGVsbG8="}]),
    ("mesh, glTF", "a texture without bytes"): _gltf(images=[{}]),
    ("mesh, glTF", "a texture where no buffer reaches"): _gltf(images=[{"bufferView": 7}]),
    ("mesh, glTF", "a texture of no image"): _gltf(textures=[{"source": 10**9}]),
    ("mesh, glTF", "a buffer from a device"): _gltf(buffers=[{"uri": "/dev/zero", "byteLength": 36}]),
    ("mesh, glTF", "a missing buffer"): _gltf(buffers=[{"uri": "none.bin", "byteLength": 36}]),
    ("mesh, glTF", "10^12 vertices of no buffer"): _gltf(
        accessors=[{"componentType": 5126, "count": 10**12, "type": "VEC3"}]
    ),
    ("mesh, glTF", "-1 vertices"): _gltf(accessors=[{"componentType": 5126, "count": -1, "type": "VEC3"}]),
    ("mesh, glTF", "a node that is its own child"): _gltf(nodes=[{"mesh": 0, "children": [0]}]),
    ("mesh, glTF", "nodes in a circle"): _gltf(nodes=[{"children": [1]}, {"mesh": 0, "children": [0]}]),
    ("mesh, glTF", "a node reached twice"): _gltf(scenes=[{"nodes": [0, 1]}], nodes=[{"children": [1]}, {"mesh": 0}]),
    ("mesh, glTF", "a matrix of NaN"): _gltf(nodes=[{"mesh": 0, "matrix": [float("nan")] * 16}]),
    ("mesh, glTF", "a texture on another machine"): _gltf(images=[{"uri": "https://a.example/a.png"}]),
    ("mesh, glTF", "indices out of every range"): _gltf(
        meshes=[{"primitives": [{"attributes": {"POSITION": 10**9}, "material": -1}]}]
    ),
    ("mesh, glTF", "10^9 sparse values"): _gltf(
        accessors=[{"componentType": 5126, "count": 3, "type": "VEC3", "sparse": {"count": 10**9}}]
    ),
    ("mesh, glTF", "a view beyond its buffer"): _gltf(bufferViews=[{"buffer": 0, "byteLength": 10**15}]),
    ("mesh, glTF", "a stride of 10^15"): _gltf(bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 10**15}]),
    ("mesh, glTF", "100,000 copies of a mesh"): _gltf(
        scenes=[{"nodes": list(range(100_000))}], nodes=[{"mesh": 0}] * 100_000
    ),
    ("mesh, glTF", "a factor that is no number"): _gltf(materials=[{"emissiveFactor": ["bright", None, 1]}]),
    ("mesh, glTF", "200,000 deep"): b'{"a":' * 200_000,
    ("mesh, glTF", "lists in place of objects"): _gltf(images=[[]], materials=[[]], accessors=3),
    ("mesh, GLB", "a part longer than the file"): b"glTF" + struct.pack("<IIII", 2, 100, 0xFFFFFFF0, 0x4E4F534A),
    ("mesh, GLB", "no header"): b"glTF" + struct.pack("<II", 2, 12) + bytes(8),
}


def _made(row: str, what: str, data: bytes) -> Case:
    reader = next(reader for reader in READERS if reader.name == row)

    def prepare(folder: pathlib.Path) -> Callable[[], object]:
        path = folder / reader.file
        reader.make(path)
        path.write_bytes(data)
        return lambda: reader.read(path)

    return Case(row, what, prepare)


def _scene_text(what: str, text: str) -> Case:
    return Case("scene, text", what, lambda folder: lambda: loads_scene(text))


def _source_name(what: str, name: str) -> Case:
    def take(folder: pathlib.Path) -> object:
        with open_source(name) as source:
            return list(source)

    return Case("name of a source", what, lambda folder: lambda: take(folder))


SINKS = ("clip.mp4", "clip.mkv", "clip.mov", "frames", "light", "layers", "one.exr", "one.hdr")
PLACES: dict[str, Callable[[pathlib.Path], object]] = {
    **{what: make for what, make in NO_FILES.items() if what not in ("8 GiB of nothing", "no bytes", "a folder")},
    "a folder with a folder in it": lambda path: (path / "0000.png" / "x").mkdir(parents=True),
    "a file of somebody else's": lambda path: path.write_text("mine"),
    "below a file": lambda path: path.write_text("mine"),
    "below a pipe": os.mkfifo,
}
PICTURES: dict[str, object] = {
    "floats": np.zeros((4, 4, 3)),
    "grey": np.zeros((4, 4), np.uint8),
    "no pixel": np.zeros((0, 4, 3), np.uint8),
    "four channels": np.zeros((4, 4, 4), np.uint8),
    "text": np.array([["x"]]),
    "objects": np.array([[[None] * 3]]),
}


SHOT = Shot(loads_scene(SCENE), 24.0, (Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5])),))
RADIANCE = np.ones((4, 8, 3), np.float32)
FILES: dict[str, Callable[[pathlib.Path], object]] = {
    "shot.usda": lambda path: write_usd(path, SHOT),
    "shot.glb": lambda path: write_glb(path, SHOT),
    "shot.jsonl": lambda path: write_track(path, SHOT),
    "lens.exr": lambda path: write_stmap(path, RADIANCE[..., :2]),
    "captured.exr": lambda path: Light(RADIANCE, RADIANCE[..., 0]).save(path),
    "traced.exr": lambda path: write_picture(
        path, TracedPicture(RADIANCE, RADIANCE, np.zeros((1, 1, 3), np.uint8), 8, 0, 0)
    ),
}
"""What commands write at their end."""


def _write(path: pathlib.Path, name: str, image: object) -> None:
    if name in FILES:
        check_replaceable(path, overwrite=False)
        make_folder(path.parent)
        FILES[name](path)
        return
    good = np.zeros((16, 16, 3), np.float32 if name in ("light", "one.exr", "one.hdr") else np.uint8)
    taken: Any = good if image is None else image
    if name.startswith("one."):
        write_environment(path, taken)
        return
    with _open(path, name) as sink:
        for _ in range(3):
            sink.write(LayerFrame({"plate": good.astype(np.float32)}, good, ()) if name == "layers" and image is None
                       else taken)  # fmt: skip


def _open(path: pathlib.Path, name: str) -> Sink:
    if name == "layers":
        return LayerSink(path, pictures=("plate",))
    return EnvironmentSink(path) if name == "light" else open_sink(path, fps=24)


def _place(name: str, what: str) -> Case:
    def prepare(folder: pathlib.Path) -> Callable[[], object]:
        path = folder / name
        PLACES[what](path)
        place = path / name if what.startswith("below") else path
        return lambda: _write(place, name, None)

    return Case(f"sink, {name}", what, prepare)


def _sink_name(name: str, what: str, text: str) -> Case:
    suffix = pathlib.Path(name).suffix
    return Case(
        f"sink, {name}", what, lambda folder: lambda: _write(pathlib.Path(f"{folder}/{text}{suffix}"), name, None)
    )


def _sink_picture(name: str, what: str) -> Case:
    def take(folder: pathlib.Path) -> None:
        try:
            _write(folder / name, name, PICTURES[what])
        except SinkError:
            left = [path for path in folder.rglob("*") if path.is_file()]
            assert not left, left
            raise

    return Case(f"sink, {name}", what, lambda folder: lambda: take(folder))


def all_cases(damages: int = DAMAGES) -> Iterator[Case]:
    """Every input, always in the same order; ``damages`` damaged copies of each file."""
    for number, reader in enumerate(READERS):
        yield _sound(reader)
        for damage in range(damages):
            yield _damage(reader, 100_000 * number + damage)
        for what in NO_FILES:
            yield _no_file(reader, what)
    for (row, what), data in MADE_TO_HURT.items():
        yield _made(row, what, data)
    for what, name in NAMES.items():
        yield _source_name(what, name)
    for number in range(damages):
        yield _scene_text(f"damage {number}", damaged(SCENE.encode(), 9_900_000 + number).decode("latin-1"))
    for name in (*SINKS, *FILES):
        for what in PLACES:
            yield _place(name, what)
        for what in ("a name of 5,000 characters", "a zero byte", "half a pair", "a terminal's commands"):
            yield _sink_name(name, what, NAMES[what])
        for what in PICTURES if name in SINKS else ():
            yield _sink_picture(name, what)
