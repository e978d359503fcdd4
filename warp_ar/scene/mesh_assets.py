"""What mesh files name or hold beside their triangles, looked at before a mesh is read.

A material library, a buffer or a texture may be a pipe that never ends, a picture whose header promises more pixels
than fit into memory, or missing: trimesh would wait, or leave a texture out without a word.
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
from pathlib import Path
from typing import Any, Final, NoReturn
from urllib.parse import unquote

from warp_ar.errors import SceneError
from warp_ar.files import is_file, limits, parse_json, read_bytes, too_much
from warp_ar.pictures import check_picture

_GLB_JSON: Final = 0x4E4F534A
_GLB_BINARY: Final = 0x004E4942
_HEADER: Final = 1 << 16
"""Bytes of a text header that are looked at."""


_CONFINED: Final[set[Path]] = set()
"""Folders of ``confine``."""


def confine(folder: Path) -> None:
    """Let mesh files in a folder name files in it only: they are not trusted, and would show what lies elsewhere."""
    _CONFINED.add(folder.resolve())


class Assets:
    """Files that a mesh file names: beside it, or relative to it."""

    def __init__(self, path: Path) -> None:
        """Find files for a mesh file; nothing is read yet."""
        self._path = path
        self._pictures_follow = path.suffix.lower() not in (".gltf", ".glb")
        self.known: dict[str, bytes] = {}
        """What was read, by the name that the mesh file has for it."""
        self._within = next((folder for folder in _CONFINED if path.resolve().is_relative_to(folder)), None)

    def get(self, name: str) -> bytes:
        """Return the bytes of a picture or buffer by the name that the mesh file has for it.

        Raises:
            SceneError: It is missing, too large or no regular file.
        """
        return self._read(name, False)

    def has(self, name: str) -> bool:
        """Return whether there is a file of a name."""
        return self._found(name) is not None

    def library(self, name: str) -> bytes | None:
        """Return a material library; None if it is not there.

        Raises:
            SceneError: It is too large, no regular file, or the mesh file may not name it.
        """
        place = self._path.parent / name.strip()
        if self._found(name) is None and not (self._reaches(place) and place.exists()):
            return None
        return self._read(name, True)

    def _found(self, name: str) -> Path | None:
        plain = name.strip()
        candidates = (plain, plain.replace("\\", "/"), plain.lstrip("/"), re.split(r"[/\\]", plain)[-1])
        paths = (self._path.parent / text for text in candidates)
        return next((path for path in paths if self._reaches(path) and is_file(path)), None)

    def _reaches(self, path: Path) -> bool:
        """Whether the file may name another one there."""
        return self._within is None or path.resolve().is_relative_to(self._within)

    def _read(self, name: str, library: bool) -> bytes:
        if name not in self.known:
            limit = "text_bytes" if library else "picture_bytes" if self._pictures_follow else "mesh_bytes"
            path = self._found(name) or self._path.parent / name.strip()
            if not self._reaches(path):
                raise SceneError(f"{self._path}: the file {name[:60]!r}, which it names, does not come with it")
            label = f"{self._path}: {path}, which it names,"
            data = read_bytes(path, limit, SceneError, label)
            if self._pictures_follow and not library:
                check_picture(data, SceneError, label)
            self.known[name] = data
        return self.known[name]


def check_counts(path: Path, data: bytes) -> None:
    """Check what the header of a PLY, OFF or STL file promises.

    Raises:
        SceneError: It is more than may be read, or than the file can hold.
    """
    suffix = path.suffix.lower()
    head = data[:_HEADER]
    counts: list[int] = []
    if suffix == ".ply":
        header = head.split(b"end_header")[0]
        counts = [int(digits[:18]) for digits in re.findall(rb"element\s+\S+\s+(\d+)", header)]
    elif suffix == ".off":
        words = re.sub(rb"\w*OFF", b" ", re.sub(rb"#[^\n]*", b"", head[:4096]), count=1).split()
        counts = [int(word[:18]) for word in words[:2] if word.isdigit()]
    elif suffix == ".stl" and len(data) >= 84 and not head.lstrip().lower().startswith(b"solid"):
        counts = [struct.unpack_from("<I", data, 80)[0]]
    for count in counts:
        _check_count(path, count)
        if count > len(data):  # every element takes a byte or more
            raise SceneError(f"{path}: its header promises {count:,} elements, and the file has {len(data):,} bytes")


def _check_count(path: Path, count: int) -> None:
    if count > limits().mesh_elements:
        raise SceneError(too_much(f"{path}", count, "vertices or faces", "mesh_elements"))


def read_gltf(path: Path, data: bytes, assets: Assets) -> tuple[dict[str, Any], list[bytes]]:
    """Header and buffers of a glTF or GLB file, looked through: sizes of accessors, buffers, and pictures.

    Raises:
        SceneError: Something is missing, too large or no picture.
    """
    tree, binary = _split_glb(path, data) if path.suffix.lower() == ".glb" else (data, b"")
    label = str(path)
    if len(tree) > limits().text_bytes and path.suffix.lower() == ".glb":
        raise SceneError(too_much(f"{label}: its header", len(tree), "bytes", "text_bytes"))
    try:
        text = tree.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{label}: the mesh cannot be read; is the file whole? (byte {error.start} is no UTF-8)"
        ) from error
    header = parse_json(text, f"{label}: its header", SceneError)
    if not isinstance(header, dict):
        fail(path, "its header is no JSON object")
    for accessor in objects(path, header, "accessors"):
        count = accessor.get("count", 0)
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            fail(path, f"an accessor has the count {str(count)[:40]!r}, which is no whole number")
        _check_count(path, count)
    buffers = [
        _uri_bytes(path, item["uri"], assets) if "uri" in item else binary for item in objects(path, header, "buffers")
    ]
    return header, buffers


def fail(path: Path, what: str) -> NoReturn:
    """Say that a mesh cannot be read.

    Raises:
        SceneError: Always, because of ``what``.
    """
    raise SceneError(f"{path}: the mesh cannot be read: {what}")


def _split_glb(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """JSON and binary chunk."""
    if len(data) < 20 or data[:4] != b"glTF":
        fail(path, "no GLB file, or cut off")
    parts: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > len(data):
            fail(path, f"cut off: a part of {length:,} bytes starts at byte {at:,} of {len(data):,}")
        parts.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if _GLB_JSON not in parts:
        fail(path, "it holds no header")
    return parts[_GLB_JSON], parts.get(_GLB_BINARY, b"")


def objects(path: Path, header: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """A list of objects of the header; empty where there is none."""
    value = header.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        fail(path, f"{key} is no list of objects")
    return value


def _uri_bytes(path: Path, uri: object, assets: Assets) -> bytes:
    if not isinstance(uri, str):
        fail(path, f"a URI is {str(uri)[:40]!r}, no text")
    if "base64," not in uri:
        if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", uri):
            fail(path, f"the URI {uri[:60]!r} is not beside it; nothing is fetched: save the file there")
        return assets.get(unquote(uri))
    try:
        return base64.b64decode(uri.partition("base64,")[2])
    except binascii.Error as error:
        raise SceneError(f"{path}: the mesh cannot be read: a URI holds no base64 ({error})") from error


def image_bytes(path: Path, header: dict[str, Any], index: object, buffers: list[bytes], assets: Assets) -> bytes:
    """File of a picture that a glTF file holds or names.

    Raises:
        SceneError: There is none, or it must not be decoded.
    """
    images = objects(path, header, "images")
    if not isinstance(index, int) or not 0 <= index < len(images):
        fail(path, f"a texture names image {str(index)[:20]}; there are {len(images)}, counted from 0")
    data = _image_bytes(path, header, images[index], buffers, assets)
    check_picture(data, SceneError, f"{path}: its image {index}")
    return data


def _image_bytes(
    path: Path, header: dict[str, Any], image: dict[str, Any], buffers: list[bytes], assets: Assets
) -> bytes:
    if "bufferView" not in image:
        return _uri_bytes(path, image.get("uri"), assets)
    views = objects(path, header, "bufferViews")
    index = image["bufferView"]
    view = views[index] if isinstance(index, int) and 0 <= index < len(views) else {}
    number, start, length = (view.get(key, 0) for key in ("buffer", "byteOffset", "byteLength"))
    sound = all(isinstance(value, int) and value >= 0 for value in (number, start, length))
    if not sound or number >= len(buffers) or length < 1 or start + length > len(buffers[number]):
        fail(path, f"an image lies at {str(index)[:20]}, where no buffer reaches")
    return bytes(buffers[number][start : start + length])
