"""glTF files for tests: arrays packed into one buffer, pictures held in it."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
"""In glTF's axes: upright, facing +Z."""
SQUARE_FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
SQUARE_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""v down: the picture stands upright on the square."""


class Gltf:
    """A file that is being made."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "meshes": [],
            "nodes": [],
        }
        self.data = b""

    def _append(self, data: bytes, **fields: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **fields})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Any, **fields: Any) -> int:
        """An accessor of (n,) or (n, k) values."""
        values = np.asarray(values)
        columns = values.reshape(len(values), -1)
        view = self._append(np.ascontiguousarray(values).tobytes())
        kind = COMPONENTS[values.dtype.str[1:]]
        form = TYPES[columns.shape[1]]
        self.tree["accessors"].append(
            {"bufferView": view, "componentType": kind, "count": len(values), "type": form, **fields}
        )
        return len(self.tree["accessors"]) - 1

    def texture(self, picture: Any, sampler: dict[str, int] | None = None) -> int:
        """A texture of (h, w, 3 or 4) RGB or RGBA of 8 bits."""
        picture = np.asarray(picture, np.uint8)
        order = [2, 1, 0, 3][: picture.shape[2]]
        encoded = cv2.imencode(".png", np.ascontiguousarray(picture[..., order]))[1].tobytes()
        images = self.tree.setdefault("images", [])
        images.append({"bufferView": self._append(encoded), "mimeType": "image/png"})
        texture: dict[str, int] = {"source": len(images) - 1}
        if sampler is not None:
            self.tree.setdefault("samplers", []).append(sampler)
            texture["sampler"] = len(self.tree["samplers"]) - 1
        self.tree.setdefault("textures", []).append(texture)
        return len(self.tree["textures"]) - 1

    def material(self, **fields: Any) -> int:
        """A material as the file has it."""
        self.tree.setdefault("materials", []).append(fields)
        return len(self.tree["materials"]) - 1

    def square(self, material: int | None = None, **attributes: Any) -> dict[str, Any]:
        """A primitive: an upright square of side 2 with texture coordinates."""
        named = {"POSITION": self.array(SQUARE), "TEXCOORD_0": self.array(SQUARE_UVS), **attributes}
        primitive: dict[str, Any] = {"attributes": named, "indices": self.array(SQUARE_FACES)}
        return primitive if material is None else {**primitive, "material": material}

    def node(self, *primitives: dict[str, Any], **fields: Any) -> int:
        """A node with a mesh."""
        self.tree["meshes"].append({"primitives": list(primitives)})
        self.tree["nodes"].append({"mesh": len(self.tree["meshes"]) - 1, **fields})
        return len(self.tree["nodes"]) - 1

    def save(self, path: Path) -> Path:
        """Write it as GLB."""
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data)}]}
        header = json.dumps(tree).encode()
        header += b" " * (-len(header) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        size = 12 + 8 + len(header) + 8 + len(data)
        path.write_bytes(
            b"glTF"
            + struct.pack("<II", 2, size)
            + struct.pack("<II", len(header), 0x4E4F534A)
            + header
            + struct.pack("<II", len(data), 0x004E4942)
            + data
        )
        return path
