"""JSON header and binary data of a glTF file; every index, count and size is checked before use."""

from __future__ import annotations

import base64
import math
import re
import struct
from typing import Any, Final, NoReturn
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import limits, parse_json, too_much
from warp_ar.pictures import check_picture
from warp_ar.scene.mesh_source import MeshSource

Array = npt.NDArray[np.float64]

_GLB_JSON: Final = 0x4E4F534A
_GLB_BINARY: Final = 0x004E4942
_COMPONENTS: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfFile:
    """Checked access to a glTF or GLB file."""

    def __init__(self, source: MeshSource) -> None:
        """Read the header and the buffers.

        Args:
            source: The file.

        Raises:
            SceneError: The file is incomplete, too large, or violates glTF. All methods raise it for these reasons.
            ValueError: The header is not UTF-8, or data in it are not base64; `mesh_files` names the file.
        """
        self.source = source
        path, data = source.path, source.data
        is_binary = path.suffix.lower() != ".gltf"
        tree, binary = self._split_glb(data) if is_binary else (data, b"")
        if len(tree) > limits().text_bytes and is_binary:
            raise SceneError(too_much(f"{path}: its header", len(tree), "bytes", "text_bytes"))
        header = parse_json(tree.decode("utf-8-sig"), f"{path}: its header", SceneError)
        if not isinstance(header, dict):
            self.fail("its header is no JSON object")
        self.header: dict[str, Any] = header
        asset = self.table(header, "asset", "its header")
        version = str(asset.get("minVersion", asset.get("version", "2.0")))
        if not re.match(r"2\.0?$", version) and not ("minVersion" not in asset and version.startswith("2.")):
            self.fail(f"it is of glTF {version[:20]}; 2.0 is read")
        self._accessors = self.objects("accessors")
        for item in self._accessors:
            source.check_count(self.whole(item, "count", "an accessor"))
        self._buffers = [self._uri_bytes(item["uri"]) if "uri" in item else binary for item in self.objects("buffers")]
        self._known: dict[int, npt.NDArray[Any]] = {}

    def fail(self, what: str) -> NoReturn:
        """Raise an error that the mesh cannot be read.

        Raises:
            SceneError: Always; ``what`` is the reason.
        """
        raise SceneError(f"{self.source.path}: the mesh cannot be read: {what}")

    # ---- values of the header ------------------------------------------------------------------------------------

    def objects(self, key: str, parent: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """Return a list of objects of the header, or of ``parent``; empty if the key is missing."""
        value = (self.header if parent is None else parent).get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            self.fail(f"{key} is no list of objects")
        return value

    def table(self, parent: dict[str, Any], key: str, label: str) -> dict[str, Any]:
        """Return the object under a key of ``parent``; empty if the key is missing."""
        value = parent.get(key)
        if value is not None and not isinstance(value, dict):
            self.fail(f"{label} has {key} {str(value)[:30]!r}, which is no object")
        return value or {}

    def index(self, value: object, count: int, what: str) -> int:
        """Return ``value`` if it is an index into ``count`` items."""
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
            self.fail(f"{what} {str(value)[:20]}; there are {count}, counted from 0")
        return value

    def indices(self, value: object, count: int, what: str) -> list[int]:
        """Return ``value`` if it is a list of indices into ``count`` items; empty if it is missing."""
        if value is not None and not isinstance(value, list):
            self.fail(f"{what} {str(value)[:30]!r}; a list of numbers is right")
        return [self.index(entry, count, what) for entry in value or []]

    def whole(self, item: dict[str, Any], key: str, label: str) -> int:
        """Return ``item[key]``, checked to be a whole number of at least 0; 0 if the key is missing."""
        value = item.get(key, 0)
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            self.fail(f"{label} has {key} {str(value)[:20]!r}, no whole number from 0 on")
        return value

    def number(
        self, item: dict[str, Any], key: str, default: float, high: float, label: str, *, low: float = 0.0
    ) -> float:
        """Return ``item[key]``, or ``default`` if the key is missing, clamped to [``low``, ``high``].

        ``label`` names the item in errors.
        """
        value = item.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.fail(f"{label} has {key} {str(value)[:30]!r}, which is no finite number")
        if not low <= value <= high:
            self.source.note(f"{key} beyond {low:g} to {high:g}")
        return min(max(float(value), low), high)

    def numbers(
        self, item: dict[str, Any], key: str, default: tuple[float, ...], high: float, label: str, *, low: float = 0.0
    ) -> tuple[float, ...]:
        """Return the list ``item[key]``, as long as ``default``, with each number clamped to [``low``, ``high``].

        A missing key gives ``default``. ``label`` names the item in errors.
        """
        value = item.get(key, default)
        if not isinstance(value, list | tuple) or len(value) != len(default):
            self.fail(f"{label} has {key} {str(value)[:30]!r}; a list of {len(default)} numbers is right")
        return tuple(self.number({key: entry}, key, 0.0, high, label, low=low) for entry in value)

    # ---- bytes ---------------------------------------------------------------------------------------------------

    def _split_glb(self, data: bytes) -> tuple[bytes, bytes]:
        """Return the JSON chunk and the binary chunk of a GLB."""
        if len(data) < 20 or data[:4] != b"glTF":
            self.fail("no GLB file, or cut off")
        parts: dict[int, bytes] = {}
        at = 12
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, at)
            if at + 8 + length > len(data):
                self.fail(f"cut off: a part of {length:,} bytes starts at byte {at:,} of {len(data):,}")
            parts.setdefault(kind, data[at + 8 : at + 8 + length])
            at += 8 + length
        if _GLB_JSON not in parts:
            self.fail("it holds no header")
        return parts[_GLB_JSON], parts.get(_GLB_BINARY, b"")

    def _uri_bytes(self, uri: object) -> bytes:
        if not isinstance(uri, str):
            self.fail(f"a URI is {str(uri)[:40]!r}, no text")
        if "base64," not in uri:
            if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", uri):
                self.fail(f"the URI {uri[:60]!r} is not beside it; nothing is fetched: save the file there")
            return self.source.get(unquote(uri), "mesh_bytes")
        return base64.b64decode(uri.partition("base64,")[2])

    def image(self, index: int) -> bytes:
        """Return the bytes of an embedded or referenced picture."""
        item = self.objects("images")[index]
        if "bufferView" in item:
            data = bytes(self._view_bytes(item["bufferView"], f"image {index}")[0])
        else:
            data = self._uri_bytes(item.get("uri"))
        check_picture(data, SceneError, f"{self.source.path}: its image {index}")
        return data

    def _view_bytes(self, number: object, what: str) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride; 0 means that the view gives no stride."""
        views = self.objects("bufferViews")
        item = views[self.index(number, len(views), f"{what} lies in buffer view")]
        label = f"buffer view {number}"
        buffer = self._buffers[self.index(item.get("buffer"), len(self._buffers), f"{label} lies in buffer")]
        start, length, stride = (self.whole(item, key, label) for key in ("byteOffset", "byteLength", "byteStride"))
        if start + length > len(buffer) or not length:
            self.fail(f"{label} has bytes {start:,} to {start + length:,} of a buffer of {len(buffer):,}")
        return memoryview(buffer)[start : start + length], stride

    # ---- arrays --------------------------------------------------------------------------------------------------

    def array(self, index: object, what: str, *widths: int) -> npt.NDArray[Any]:
        """Return the elements of an accessor as float64; integers that are not normalized stay integers.

        Args:
            index: Index of the accessor in the file.
            what: Description of the data, for messages.
            widths: Allowed numbers of components per element.

        Returns:
            Elements, (count, width).
        """
        number = self.index(index, len(self._accessors), f"{what} is accessor")
        if number not in self._known:
            self._known[number] = self._decode(self._accessors[number], f"accessor {number}")
        values = self._known[number]
        if values.shape[1] not in widths:
            right = " or ".join(map(str, widths))
            self.fail(f"{what} is accessor {number}, of {values.shape[1]} numbers each; {right} are right")
        return values

    def _decode(self, accessor: dict[str, Any], label: str) -> npt.NDArray[Any]:
        kind, form = accessor.get("componentType"), accessor.get("type")
        if kind not in _COMPONENTS or form not in _WIDTHS:
            self.fail(f"{label} has type {str(form)[:20]} of {str(kind)[:20]}; glTF has no such")
        dtype, width, count = np.dtype(_COMPONENTS[kind]), _WIDTHS[form], accessor.get("count", 0)
        values: npt.NDArray[Any] = np.zeros((count, width), dtype)
        if "bufferView" in accessor:
            values = self._elements(accessor, count, dtype, width, label)
        if "sparse" in accessor:
            values = self._overlay(values, self.table(accessor, "sparse", label), label)
        if dtype.kind == "f":
            return values.astype(np.float64)
        if accessor.get("normalized") is True:
            # Signed integers map symmetrically: both -128 and -127 become -1.
            return np.maximum(values / float(np.iinfo(dtype).max), -1.0)
        return values

    def _elements(self, item: dict[str, Any], count: int, dtype: Any, width: int, label: str) -> npt.NDArray[Any]:
        """Return the elements of an accessor's buffer view, packed or with a stride."""
        data, stride = self._view_bytes(item.get("bufferView"), label)
        offset, size = self.whole(item, "byteOffset", label), dtype.itemsize * width
        stride = stride or size
        needed = offset + stride * (count - 1) + size if count else 0
        if stride < size:
            self.fail(f"{label} has elements of {size} bytes, one every {stride}")
        if needed > len(data):
            self.fail(f"{label} needs {needed:,} bytes; its view has {len(data):,}")
        rows = np.ndarray((count, size), np.uint8, data, offset if count else 0, (stride, 1))
        values: npt.NDArray[Any] = np.ascontiguousarray(rows).view(dtype).reshape(count, width)
        return values

    def _overlay(self, values: npt.NDArray[Any], sparse: dict[str, Any], label: str) -> npt.NDArray[Any]:
        """Return a copy of ``values`` in which the elements listed by a sparse accessor are replaced."""
        label = f"the sparse part of {label}"
        where, other = self.table(sparse, "indices", label), self.table(sparse, "values", label)
        count, kind = self.whole(sparse, "count", label), where.get("componentType")
        if kind not in (5121, 5123, 5125) or count > len(values):
            self.fail(f"{label} has {count:,} indices of type {str(kind)[:20]} for {len(values):,} elements")
        places = self._elements(where, count, np.dtype(_COMPONENTS[kind]), 1, label)[:, 0]
        if count and int(places.max()) >= len(values):
            self.fail(f"{label} is at {int(places.max())}; there are {len(values)} elements")
        result = values.copy()
        result[places] = self._elements(other, count, values.dtype, values.shape[1], label)
        return result
