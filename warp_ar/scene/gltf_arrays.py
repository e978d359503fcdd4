"""Numbers of a glTF file: accessors over buffer views, sparse ones and those of fewer bits included."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.scene.mesh_assets import fail, objects

_COMPONENTS: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfArrays:
    """Reads accessors; every index and size is checked before it is used."""

    def __init__(self, path: Path, header: dict[str, Any], buffers: list[bytes]) -> None:
        """Read nothing yet.

        Args:
            path: The file, for messages.
            header: Its JSON.
            buffers: Bytes of each buffer.
        """
        self._path, self._buffers = path, buffers
        self._accessors, self._views = (objects(path, header, key) for key in ("accessors", "bufferViews"))
        self._known: dict[int, npt.NDArray[Any]] = {}

    def read(self, index: object, what: str, widths: tuple[int, ...]) -> npt.NDArray[Any]:
        """Elements of an accessor: integers as they are unless they are normalized, else float64.

        Args:
            index: Its number, as the file has it.
            what: What it is, for messages.
            widths: Numbers per element that are right.

        Returns:
            (count, width).

        Raises:
            SceneError: There is no such accessor, or it does not hold such elements.
        """
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(self._accessors):
            fail(self._path, f"{what} is accessor {str(index)[:20]}; there are {len(self._accessors)}, counted from 0")
        if index not in self._known:
            self._known[index] = self._decode(index)
        values = self._known[index]
        if values.shape[1] not in widths:
            right = " or ".join(map(str, widths))
            fail(self._path, f"{what} is accessor {index}, of {values.shape[1]} numbers each; {right} are right")
        return values

    def _decode(self, index: int) -> npt.NDArray[Any]:
        accessor = self._accessors[index]
        kind, form = accessor.get("componentType"), accessor.get("type")
        if kind not in _COMPONENTS or form not in _WIDTHS:
            fail(self._path, f"accessor {index} has type {str(form)[:20]} of {str(kind)[:20]}; glTF has no such")
        dtype, width, count = np.dtype(_COMPONENTS[kind]), _WIDTHS[form], self._whole(accessor, "count", index)
        if "bufferView" in accessor:
            start = self._whole(accessor, "byteOffset", index)
            values = self._view(accessor["bufferView"], start, count, dtype, width, f"accessor {index}")
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._overlay(values, accessor["sparse"], dtype, width, index)
        if dtype.kind == "f":
            return values.astype(np.float64)
        if accessor.get("normalized") is True:
            # Signed ones are symmetric: -128 and -127 are both -1.
            return np.maximum(values / float(np.iinfo(dtype).max), -1.0)
        return values

    def _whole(self, item: dict[str, Any], key: str, index: int) -> int:
        value = item.get(key, 0)
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            fail(self._path, f"accessor {index} has {key} {str(value)[:20]!r}, no whole number from 0 on")
        return value

    def _view(self, view: object, offset: int, count: int, dtype: Any, width: int, what: str) -> npt.NDArray[Any]:
        """Elements of a buffer view, packed or with a stride."""
        if isinstance(view, bool) or not isinstance(view, int) or not 0 <= view < len(self._views):
            fail(self._path, f"{what} lies in buffer view {str(view)[:20]}; there are {len(self._views)}")
        item = self._views[view]
        number, start, length = (item.get(key, 0) for key in ("buffer", "byteOffset", "byteLength"))
        size = dtype.itemsize * width
        stride = item.get("byteStride", size)
        numbers = (number, start, length, stride)
        sound = all(isinstance(value, int) and not isinstance(value, bool) and value >= 0 for value in numbers)
        if not sound or number >= len(self._buffers) or start + length > len(self._buffers[number]) or stride < size:
            fail(self._path, f"{what} lies in buffer view {view}, which no buffer holds")
        if count and offset + stride * (count - 1) + size > length:
            fail(self._path, f"{what} needs {offset + stride * (count - 1) + size:,} bytes; its view has {length:,}")
        if not count:
            return np.zeros((0, width), dtype)
        raw = np.frombuffer(self._buffers[number], np.uint8, stride * (count - 1) + size, start + offset)
        rows = np.lib.stride_tricks.as_strided(raw, (count, size), (stride, 1), writeable=False)
        values: npt.NDArray[Any] = np.ascontiguousarray(rows).view(dtype).reshape(count, width)
        return values

    def _overlay(
        self, values: npt.NDArray[Any], sparse: object, dtype: Any, width: int, index: int
    ) -> npt.NDArray[Any]:
        """Elements with a few put in place of others."""
        table: dict[str, Any] = sparse if isinstance(sparse, dict) else {}
        where, other = table.get("indices"), table.get("values")
        if not isinstance(where, dict) or not isinstance(other, dict):
            fail(self._path, f"accessor {index} is sparse without indices and values")
        count = self._whole(table, "count", index)
        kind = where.get("componentType")
        if kind not in (5121, 5123, 5125) or count > len(values):
            fail(self._path, f"accessor {index} is sparse with indices of type {str(kind)[:20]}, {count:,} of them")
        label = f"the sparse part of accessor {index}"
        start = self._whole(where, "byteOffset", index)
        places = self._view(where.get("bufferView"), start, count, np.dtype(_COMPONENTS[kind]), 1, label)[:, 0]
        if count and int(places.max()) >= len(values):
            fail(self._path, f"accessor {index} is sparse at {int(places.max())}; it has {len(values)} elements")
        start = self._whole(other, "byteOffset", index)
        result = values.copy()
        result[places] = self._view(other.get("bufferView"), start, count, dtype, width, label)
        return result
