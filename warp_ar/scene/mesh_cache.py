"""Meshes as they were read from their files, kept for the next run: reading takes half a second of imports alone.

Only files that hold all of their mesh are kept, under a hash of their bytes and of the code that reads them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.cache_folder import cache_folder
from warp_ar.files import write_whole
from warp_ar.scene import geometry, mesh_files, mesh_materials

_CODE = (
    "geometry",
    "gltf",
    "gltf_animation",
    "gltf_arrays",
    "gltf_materials",
    "mesh_assets",
    "mesh_files",
    "mesh_materials",
    "mesh_parts",
    "mtl",
    "node_animation",
    "polygon_files",
)
"""Modules of this package that decide how a file is read."""
WHOLE = (".ply", ".stl", ".off", ".glb")
"""Formats without files beside them."""
_HEADER = 1 << 16
"""Bytes of a PLY within which it names a picture beside it."""
MOST_BYTES = 256 << 20
"""Of a file that is kept."""


def load_kept_mesh(path: Path) -> geometry.Mesh:
    """As ``mesh_files.load_mesh``, from what an earlier run kept if the file is the same.

    Raises:
        SceneError: As ``mesh_files.load_mesh``.
    """
    try:
        if path.suffix.lower() not in WHOLE or path.stat().st_size > MOST_BYTES:
            return mesh_files.load_mesh(path)
        data = path.read_bytes()
        if b"TextureFile" in data[:_HEADER]:
            return mesh_files.load_mesh(path)
        code = b"".join(Path(__file__).with_name(f"{name}.py").read_bytes() for name in _CODE)
        key = hashlib.sha256(code + data).hexdigest()[:32]
    except OSError:
        return mesh_files.load_mesh(path)  # which says what is wrong
    kept = cache_folder() / "meshes" / f"{key}{path.suffix.lower()}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile), np.load(kept) as values:
        return _unpacked({name: values[name] for name in values.files})
    mesh = mesh_files.load_mesh(path)
    with contextlib.suppress(OSError):  # a disk that is full or read-only only costs the time again
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_whole(kept, lambda part: np.savez(part, **_packed(mesh)), suffix=".npz")
    return mesh


def _packed(mesh: geometry.Mesh) -> dict[str, Any]:
    """A mesh as arrays by name."""
    values = {field.name: getattr(mesh, field.name) for field in dataclasses.fields(mesh)}
    values["materials"] = np.array(mesh_materials.dump_materials(mesh.materials))
    values["notes"] = np.array(list(mesh.notes), dtype=str)
    values |= {f"image_{index}": image for index, image in enumerate(values.pop("images"))}
    return {name: value for name, value in values.items() if value is not None}


def _unpacked(values: dict[str, Any]) -> geometry.Mesh:
    """A mesh of what ``_packed`` made."""
    images = tuple(values.pop(f"image_{index}") for index in range(sum(name.startswith("image_") for name in values)))
    materials = mesh_materials.parse_materials(str(values.pop("materials")))
    notes = tuple(map(str, values.pop("notes")))
    return geometry.Mesh(**values, images=images, materials=materials, notes=notes)
