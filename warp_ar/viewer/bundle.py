"""A scene with all files that it names, as a ZIP that loads elsewhere: unpacked by ``live``, or dropped onto a page."""

from __future__ import annotations

import dataclasses
import io
import re
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any, Final, TypeVar

from warp_ar.errors import SceneError, UsageError
from warp_ar.files import read_bytes
from warp_ar.scene import Scene, dumps_scene
from warp_ar.scene.mesh_files import MESH_SUFFIXES, files_beside
from warp_ar.scene.scene_files import files_of

SCENE: Final = "scene.toml"
MOST_MEMBERS: Final = 256
"""Files of a ZIP that is taken."""
_KINDS: Final = {*MESH_SUFFIXES, ".mtl", ".bin", ".exr", ".hdr", ".txt", ".json", ".usda", ".usdc", ".usd"} | {
    *(".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".ppm", ".ktx2")
}
"""Endings of what a scene names."""
LONGEST_NAME: Final = 200
"""Characters of a member's name with its folders."""
MOST_LEVELS: Final = 8
"""Folders within each other that a member may lie in."""
_T = TypeVar("_T")


def pack_scene(scene: Scene) -> bytes:
    """The scene as ``scene.toml``, and beside it its meshes with their materials, its light, response and poses.

    A video or a folder of frames is not packed, nor named: it may be gigabytes.

    Raises:
        WarpArError: A file cannot be read.
    """
    source = scene.source
    if source is not None and source.path is not None:
        scene = dataclasses.replace(scene, source=None)
    places: dict[Path, Path] = {}
    members: dict[str, bytes] = {}
    for path in dict.fromkeys(files_of(dataclasses.replace(scene, path=None))):
        folder = PurePosixPath(f"{len(places):02d}-{_plain(path.stem)}")
        inside = folder / f"{_plain(path.stem)}{path.suffix.lower()}"
        places[path] = Path(inside)
        members[str(inside)] = read_bytes(path, "mesh_bytes", SceneError)
        if path.suffix.lower() in MESH_SUFFIXES:
            members |= {str(folder / _beside(name)): data for name, data in files_beside(path).items()}
    text = dumps_scene(dataclasses.replace(_moved(scene, places), path=None))
    head = "# With all that it names but its frames: python -m warp_ar.live FOLDER --source PATH|INDEX\n"
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(SCENE, head + text)
        for name, data in members.items():
            file.writestr(name, data)
    return packed.getvalue()


def unpack_scene(name: str, data: bytes, folder: Path, most: int) -> Path:
    """Unpack such a ZIP; the path of its scene file.

    Args:
        name: To show.
        data: The ZIP; nothing of it is trusted.
        folder: Empty folder for its files.
        most: Bytes that it may unpack to.

    Raises:
        UsageError: It is none, or too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            members = [member for member in file.infolist() if not member.is_dir()]
            _check_members(name, members, most)
            # A bomb's header may lie: no more is read than it says.
            contents = {}
            for member in members:
                with file.open(member) as opened:
                    contents[member.filename] = opened.read(member.file_size + 1)
                if len(contents[member.filename]) != member.file_size:
                    raise UsageError(f"{name}: {_shown(member.filename)} is not as large as its header says")
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise UsageError(f"{name}: no ZIP that can be unpacked: {str(error)[:120]}") from error
    for inside, content in contents.items():
        path = folder / inside
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder / SCENE


def _check_members(name: str, members: list[zipfile.ZipInfo], most: int) -> None:
    names = [member.filename for member in members]
    if SCENE not in names:
        raise UsageError(f"{name}: holds no {SCENE}; expected what Save, Scene with its files made")
    if len(set(names)) < len(names) or len(names) > MOST_MEMBERS:
        raise UsageError(f"{name}: {len(names)} files; expected at most {MOST_MEMBERS}, each once")
    if (size := sum(member.file_size for member in members)) > most:
        raise UsageError(f"{name} unpacks to {size:,} bytes; at most {most:,} are taken")
    for inside in names:
        parts = PurePosixPath(inside)
        if len(inside) > LONGEST_NAME or len(parts.parts) > MOST_LEVELS + 1:
            limits = f"at most {LONGEST_NAME} characters and {MOST_LEVELS} folders within each other are taken"
            raise UsageError(f"{name}: {_shown(inside)} ... has {len(inside)} characters; {limits}")
        plain = re.fullmatch(r"[\w .()-]+(/[\w .()-]+)*", inside) and ".." not in parts.parts
        if not plain or (inside != SCENE and parts.suffix.lower() not in _KINDS):
            raise UsageError(f"{name}: {_shown(inside)} is nothing that a scene names")
    folders = {str(folder) for inside in names for folder in PurePosixPath(inside).parents}
    if both := folders.intersection(names):
        raise UsageError(f"{name}: {_shown(min(both))} is a file and a folder")


def _moved(value: _T, places: dict[Path, Path]) -> _T:
    """A scene, or a part of one, with its files elsewhere."""

    def moved(item: Any) -> Any:
        if isinstance(item, Path):
            return places.get(item, item)
        if isinstance(item, tuple):
            return tuple(moved(entry) for entry in item) if list(files_of(item)) else item
        return _moved(item, places)

    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    changes = {field.name: moved(getattr(value, field.name)) for field in dataclasses.fields(value) if field.init}
    return dataclasses.replace(value, **{key: new for key, new in changes.items() if new is not getattr(value, key)})


def _beside(name: str) -> str:
    """The place beside a mesh under which it finds what it names: its own name where that stays inside."""
    plain = name.strip().replace("\\", "/")
    inside = re.fullmatch(r"[\w .()-]+(/[\w .()-]+)*", plain) and ".." not in PurePosixPath(plain).parts
    return plain if inside else plain.rsplit("/", 1)[-1]


def _plain(stem: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:40] or "file"


def _shown(name: str) -> str:
    return re.sub(r"[^\w .()/-]+", "_", name)[:60]
