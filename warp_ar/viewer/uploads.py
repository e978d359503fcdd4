"""Files that a viewer drops onto the picture (meshes, captured light, scenes), and scenes packed with their files.

Dropped files are not trusted. A file's name only selects its reader and appears in messages. The content is kept in a
temporary folder of the page, within limits, until the program ends. A dropped scene may name only files of the shown
scene and files dropped before, a dropped mesh only files of its own folder. So the page gives no access to other files
of this machine.
"""

from __future__ import annotations

import dataclasses
import io
import re
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np

from warp_ar.errors import SceneError, SinkError, UsageError, WarpArError, reason
from warp_ar.files import read_bytes
from warp_ar.light.captured import Light
from warp_ar.scene import CapturedLight, Object, Scene, dumps_scene, load_scene, loads_scene
from warp_ar.scene.mesh_files import MESH_SUFFIXES, load_mesh, referenced_files
from warp_ar.scene.mesh_source import confine
from warp_ar.scene.scene_files import SceneFiles, files_of
from warp_ar.viewer.edits import Wanted, add_item, moved
from warp_ar.viewer.protocol import MOST_BYTES

SCENE: Final = "scene.toml"
MOST_MEMBERS: Final = 256
"""Largest number of files in a ZIP."""
_KINDS: Final = {*MESH_SUFFIXES, ".mtl", ".bin", ".exr", ".hdr", ".txt", ".json", ".usda", ".usdc", ".usd"} | {
    *(".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".ppm", ".ktx2")
}
"""Endings of files that a scene may name."""
LONGEST_NAME: Final = 200
"""Largest number of characters of a ZIP member's path."""


def pack_scene(scene: Scene) -> bytes:
    """Return a ZIP of the scene: ``scene.toml`` with its meshes and their materials, light, response and poses.

    A source that is a video or a folder of frames is left out, as it may have gigabytes.

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
            members |= {str(folder / _packed_path(name)): data for name, data in referenced_files(path).items()}
    text = dumps_scene(dataclasses.replace(moved(scene, lambda path: places.get(path, path)), path=None))
    head = "# With all that it names but its frames: python -m warp_ar.live FOLDER --source PATH|INDEX\n"
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(SCENE, head + text)
        for name, data in members.items():
            file.writestr(name, data)
    return packed.getvalue()


_HIDDEN: Final = re.compile(r"(^|/)(__MACOSX/|\.(?!\.?/))")
"""Pattern of the files that macOS adds to a ZIP: ``__MACOSX``, ``._NAME``, ``.DS_Store``."""


def unpack_scene(name: str, data: bytes, folder: Path, most: int) -> Path:
    """Unpack a ZIP of ``pack_scene``; return the path of its scene file.

    Args:
        name: Name of the ZIP in messages.
        data: Content of the ZIP, which is not trusted.
        folder: Empty folder for the unpacked files.
        most: Largest unpacked size, bytes.

    Raises:
        UsageError: The ZIP is invalid or too large.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            found = (member for member in file.infolist() if not member.is_dir())
            members = [member for member in found if not _HIDDEN.search(member.filename)]
            _check_members(name, members, most)
            file.extractall(folder, members)  # reads no more bytes than the checked headers state
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise UsageError(f"{name}: no ZIP that can be unpacked: {str(error)[:120]}") from error
    return folder / SCENE


def _check_members(name: str, members: list[zipfile.ZipInfo], most: int) -> None:
    names = [member.filename for member in members]
    if SCENE not in names:
        raise UsageError(f"{name}: holds no {SCENE}; expected what Save, Scene with its files made")
    if len(set(names)) < len(names) or len(names) > MOST_MEMBERS:
        raise UsageError(f"{name}: {len(names)} files; expected at most {MOST_MEMBERS}, each once")
    if (size := sum(member.file_size for member in members)) > most:
        raise UsageError(f"{name} unpacks to {_megabytes(size)}; at most {_megabytes(most)} are taken")
    for inside in names:
        if not _is_plain(inside) or (inside != SCENE and PurePosixPath(inside).suffix.lower() not in _KINDS):
            raise UsageError(f"{name}: {_shown(inside)} is no file that a scene may name")


def _packed_path(name: str) -> str:
    """Return the relative path at which a mesh's own file is packed: as the mesh names it, if that is safe."""
    plain = name.strip().replace("\\", "/")
    return plain if _is_plain(plain) else plain.rsplit("/", 1)[-1]


def _is_plain(path: str) -> bool:
    """Return True for a relative path of at most LONGEST_NAME plain characters that leads into no folder above."""
    plain = len(path) <= LONGEST_NAME and re.fullmatch(r"[\w .()-]+(/[\w .()-]+)*", path)
    return bool(plain) and ".." not in PurePosixPath(path).parts


def _plain(stem: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:40] or "file"


MOST_FILES: Final = 32
"""Largest number of dropped files in one run; files of undone edits are kept for redo."""
MOST_KEPT_BYTES: Final = 1 << 29
"""Largest total size of dropped files in one run, bytes: 512 MB."""
MOST_TRIANGLES: Final = 1_000_000
"""Largest number of triangles of a dropped mesh."""
SIZES: Final = (0.02, 0.4)
"""Plausible range of an object's longest side, metres, by which the units of a mesh are guessed."""
USUAL: Final = 0.12
"""Longest side given to a mesh whose units cannot be guessed, metres."""
PLACE: Final = (0.12, -0.08)
"""Place of a dropped mesh, metres."""
LIGHTS: Final = (".exr", ".hdr")
SUFFIXES: Final = (*MESH_SUFFIXES, *LIGHTS, ".toml", ".zip")

Edit = tuple[Callable[[Wanted], Wanted], str, str]
"""Edit of the wanted state: the function from the present state to the next, its label, and its description."""


class DroppedFiles:
    """Storage of dropped files. The caller passes one file at a time."""

    def __init__(self, folder: Path) -> None:
        """Store files in numbered folders of ``folder``, which must exist."""
        self._folder, self._count = folder, 0

    def take(self, name: str, data: bytes, wanted: Wanted) -> Edit:
        """Store a file and return the edit that adds it to the scene. After an error nothing of the file is kept.

        Args:
            name: Name of the file.
            data: Content of the file, which the server has limited to ``MOST_BYTES``.
            wanted: Shown state.

        Raises:
            UsageError: The file cannot be used.
            SinkError: The file cannot be written, for example because the disk is full.
        """
        suffix = Path(name).suffix.lower()
        if suffix not in SUFFIXES:
            raise UsageError(f"{_shown(name)}: expected a file that ends in {', '.join(SUFFIXES)}")
        if suffix == ".toml":
            return self._scene_edit(_shown(name), data, wanted)
        if self._count >= MOST_FILES:
            raise UsageError(f"{MOST_FILES} files were dropped already; start the program anew for more")
        stem = _plain(Path(name).stem)
        if any(self._folder.glob(f"*/{stem}{suffix}")):
            stem += f"-{self._count + 1}"  # a saved scene names files without folders, so names must be unique
        # Each file has its own folder, with all that is unpacked from it, so that a refusal removes just this folder.
        place = self._folder / f"{self._count:02d}"
        path = place / f"{stem}{suffix}"
        try:
            self._check_room(len(data))
            place.mkdir()
            confine(place)
            if suffix == ".zip":
                edit = _bundle_edit(_shown(name), data, place, wanted)
            else:
                path.write_bytes(data)
                edit = _light_edit(_shown(name), path) if suffix in LIGHTS else _mesh_edit(_shown(name), path, wanted)
            self._check_room(0)
        except BaseException as error:
            shutil.rmtree(place, ignore_errors=True)
            if isinstance(error, OSError):
                raise SinkError(f"{_shown(name)} cannot be kept: {reason(error)}") from error
            if isinstance(error, WarpArError):  # viewers see the file's name without this machine's folders
                words = re.sub(rf"{re.escape(str(path.with_suffix('')))}(\.\w+)?", _shown(name), str(error))
                raise UsageError(words.replace(str(place), _shown(name))) from error
            raise
        self._count += 1
        return edit

    def _scene_edit(self, name: str, data: bytes, wanted: Wanted) -> Edit:
        try:
            text = data.decode()
        except ValueError as error:
            raise UsageError(f"{name}: not valid TOML: {str(error)[:160]}") from error
        folder = Path() if wanted.scene.path is None else wanted.scene.path.parent
        files = _files(folder, (), wanted)
        # A scene saved by the page names files that were dropped or measured before; find them by their names.
        shown = [path for path in files_of(wanted.scene) if path.is_relative_to(self._folder)]
        dropped = {path.name: path for path in (*self._folder.glob("[0-9][0-9]/*"), *shown) if path.is_file()}
        files = dataclasses.replace(files, names=dropped)
        scene = dataclasses.replace(loads_scene(text, name, files), path=wanted.scene.path)
        return lambda w: Wanted(scene, w.quality, cameras=w.cameras), f"open {name}", f"{name}: the scene is shown."

    def _check_room(self, more: int) -> None:
        """Raise a UsageError if ``more`` bytes would exceed the limit of stored bytes."""
        kept = more + sum(file.stat().st_size for file in self._folder.glob("[0-9][0-9]/**/*") if file.is_file())
        if kept > MOST_KEPT_BYTES:
            raise UsageError(
                f"{_megabytes(kept)} would be kept; at most {_megabytes(MOST_KEPT_BYTES)} are: start the program anew"
            )


def _megabytes(count: int) -> str:
    return f"{count / (1 << 20):.3g} MB"


def _shown(name: str) -> str:
    """Return a file's name for messages: at most 60 plain characters, without folders."""
    return re.sub(r"[^\w .()-]+", "_", Path(name).name)[:60]


def _mesh_edit(name: str, path: Path, wanted: Wanted) -> Edit:
    mesh = load_mesh(path)
    if len(mesh.faces) > MOST_TRIANGLES:
        raise UsageError(f"{name} has {len(mesh.faces):,} triangles; at most {MOST_TRIANGLES:,} are taken")
    low, high = np.asarray(mesh.bounds, float)
    longest = float((high - low).max())
    if not longest > 0.0:
        raise SceneError(f"{name}: all its vertices are at one point")
    # Files are usually in metres, or in millimetres if meant for 3D printers; otherwise units are unknown.
    scale = next((unit for unit in (1.0, 0.001) if SIZES[0] <= longest * unit <= SIZES[1]), USUAL / longest)
    middle = (low + high) / 2
    at = PLACE[0] - scale * middle[0], PLACE[1] - scale * middle[1], -scale * low[2]
    x, y, z = (round(float(value), 5) for value in at)
    item = Object("mesh", file=path, at=(x, y, z), scale=float(f"{scale:.6g}"))
    add_item(wanted.scene, "object", item)  # raises its errors now, before the file is accepted
    sides = " x ".join(f"{1e3 * scale * side:.0f}" for side in high - low)
    units = {1.0: "metres", 0.001: "millimetres"}.get(scale, "units of its own, so its longest side is 120 mm")
    words = f"{name}: {len(mesh.faces):,} triangles, {sides} mm, taken to be in {units}."
    if mesh.notes:
        words += f" Not shown: {'; '.join(mesh.notes[:4])}."
    return lambda w: dataclasses.replace(w, scene=add_item(w.scene, "object", item)), f"drop {name}", words


def _light_edit(name: str, path: Path) -> Edit:
    light = Light.load(path)
    captured = CapturedLight(path)
    height, width = light.radiance.shape[:2]
    words = f"{name}: its light ({width}x{height} texels) replaces the mirror ball's. Undo restores that."
    return lambda w: w.with_scene(captured=captured), f"light by {name}", words


def _bundle_edit(name: str, data: bytes, folder: Path, wanted: Wanted) -> Edit:
    """Return the edit that opens a scene from a ZIP of the scene and its files."""
    path = unpack_scene(name, data, folder, MOST_BYTES)
    own = [file for file in folder.rglob("*") if file.is_file()]
    scene = load_scene(path, _files(path.parent, own, wanted))
    for item in scene.objects:
        if item.file is not None and (count := len(load_mesh(item.file).faces)) > MOST_TRIANGLES:
            raise UsageError(f"{name}: a mesh has {count:,} triangles; at most {MOST_TRIANGLES:,} are taken")
    scene = dataclasses.replace(scene, path=wanted.scene.path)
    return lambda w: Wanted(scene, w.quality, cameras=w.cameras), f"open {name}", f"{name}: the scene is shown."


def _files(folder: Path, own: Iterable[Path], wanted: Wanted) -> SceneFiles:
    """Return the files that a dropped scene may name: its own and the shown scene's."""
    source = wanted.scene.source
    cameras = () if source is None or source.camera is None else (source.camera,)
    return SceneFiles.of(folder, [*own, *files_of(wanted.scene)], cameras)
