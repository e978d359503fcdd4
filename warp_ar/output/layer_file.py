"""Layers of frames as files: a multi-part OpenEXR per frame, and PNGs of layers that PNG can store.

    picture = (1 - alpha) max(plate * shadow_ratio + added_light + mirror_ball, 0) + objects
    code = encode(exposureScale * picture)

The first part, ``picture``, is that sum as linear radiance, present if all five layers are. Radiance and ratios are
16-bit floats, as compositors expect; depth, positions, motion and surface numbers have 32 bits. Parts and channels have
the layer's name (``objects.R``), except for OpenEXR's standard names: ``R``, ``G``, ``B``, ``A`` of the picture and
``Z`` of the depth. ``coverage`` becomes Cryptomatte's ``CryptoObject``: a name's hash as a float, and a manifest of
names by hash [Cry].

PNGs are in a folder per layer: the plate in the camera's codes; surface numbers, 1 more than in ``ids``, 0 for none;
depth in tenths of a millimetre, 0 for none or beyond 6.5535 m; normals as 32767.5 (n + 1).

References:
    [Cry] Friedman, Jones, "Cryptomatte Specification" 1.2, Psyop, 2016.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.closing import Closing
from warp_ar.engine.layers import compose_layers
from warp_ar.engine.result import Result
from warp_ar.errors import SinkError, UsageError
from warp_ar.exr_file import LARGEST, exr_header, store_exr
from warp_ar.files import store
from warp_ar.output.sink import make_folder
from warp_ar.output.sinks import EnvironmentSink, FolderSink
from warp_ar.scene import Scene
from warp_ar.scene.geometry import placement
from warp_ar.scene.messages import nearest
from warp_ar.scene.object_shapes import surface_names
from warp_ar.signals import REC_709
from warp_ar.signature import encode_png
from warp_ar.stages.request import LAYERS, PICTURE_LAYERS

Layers = Mapping[str, npt.NDArray[Any]]

PICTURES = ("plate", "ids", "depth", "normals")
"""Layers that PNG can store."""
DEPTH_STEP = 1e-4
"""Metres per step of a depth in a PNG."""
MATTES = "CryptoObject"
"""Name of the Cryptomatte layer."""

# Channels of a layer that are not R, G and B, and True if they have 32 bits.
_CHANNELS: dict[str, tuple[tuple[str, ...], type]] = {
    "depth": (("Z",), np.float32),
    "ids": (("ids.I",), np.uint32),
    "objects": (tuple(f"objects.{c}" for c in "RGBA"), np.float16),
    "motion": (tuple(f"motion.{c}" for c in "XY"), np.float32),
    "position": (tuple(f"position.{c}" for c in "XYZ"), np.float32),
    "normals": (tuple(f"normals.{c}" for c in "XYZ"), np.float32),
    "picture": (tuple("RGB"), np.float16),
}


@dataclasses.dataclass(frozen=True)
class LayerFrame:
    """Layers of one frame, with metadata for a file."""

    layers: Layers
    """Layers by name; the names are those of ``LAYERS``."""
    frame: npt.NDArray[np.uint8]
    """The camera's frame, RGB."""
    names: tuple[str, ...]
    """Names of the surfaces, by surface number."""
    exposure_scale: float = 1.0
    """Factor on the composed radiance in the picture."""
    transfer: str = "srgb"
    """Transfer function by which the picture encodes radiance."""
    camera_from_world: npt.NDArray[np.float64] | None = None
    """``camera_from_world``, (4, 4), camera axes x right, y down, z forward, metres; None if unknown."""
    camera_matrix: npt.NDArray[np.float64] | None = None
    """Camera matrix, (3, 3), in pixels with centres at integers."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width, 3)."""
        return self.frame.shape

    def copy(self) -> LayerFrame:
        """Return a copy with a frame of its own, because the source may reuse the frame's memory."""
        return dataclasses.replace(self, frame=self.frame.copy())


def write_layers(path: pathlib.Path, frame: LayerFrame) -> None:
    """Write the OpenEXR of one frame.

    Raises:
        SinkError: The file cannot be written.
    """
    layers = dict(frame.layers)
    if set(PICTURE_LAYERS) <= layers.keys():
        layers = {"picture": compose_layers(layers), **layers}
    if "ids" in layers:
        layers["ids"] = layers["ids"] + 1
    parts = []
    for name, values in layers.items():
        if name == "coverage":
            parts.append(_part(name, matte_channels(values, frame.names), frame, matte_header(frame.names)))
            continue
        names, kind = _CHANNELS.get(name, (tuple(f"{name}.{c}" for c in "RGB"), np.float16))
        values = values[..., None] if values.ndim == 2 else values
        values = (np.clip(values, -LARGEST, LARGEST) if kind is np.float16 else values).astype(kind)
        channels = {channel: np.ascontiguousarray(values[..., k]) for k, channel in enumerate(names)}
        parts.append(_part(name, channels, frame, {}))
    store_exr(path, OpenEXR.File(parts))


def _part(name: str, channels: dict[str, Any], frame: LayerFrame, more: Mapping[str, Any]) -> Any:
    scale = float(frame.exposure_scale)
    header = exr_header(chromaticities=REC_709, exposureScale=scale, transfer=frame.transfer, **more)
    if frame.camera_from_world is not None:
        header["cameraFromWorld"] = frame.camera_from_world.astype(np.float32)
        # OpenEXR's standard attribute is for row vectors, and a camera that faces -z with y up.
        rows = (np.diag([1.0, -1.0, -1.0, 1.0]) @ frame.camera_from_world).T
        header["worldToCamera"] = np.ascontiguousarray(rows, np.float32)  # written in memory order
    if frame.camera_matrix is not None:
        header["cameraMatrix"] = frame.camera_matrix.astype(np.float32)
    return OpenEXR.Part(header, channels, name)


def murmur3(data: bytes) -> int:
    """Return the 32-bit MurmurHash3 (x86) of bytes, seed 0."""
    mask = 0xFFFFFFFF
    state, whole = 0, len(data) // 4 * 4
    for at in (*range(0, whole, 4), *[whole] * (len(data) > whole)):
        block = int.from_bytes(data[at : at + 4], "little") * 0xCC9E2D51 & mask
        state ^= (block << 15 | block >> 17) * 0x1B873593 & mask
        if at < whole:
            state = ((state << 13 | state >> 19) & mask) * 5 + 0xE6546B64 & mask
    state ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        state = (state ^ state >> shift) * factor & mask
    return state ^ state >> 16


def matte_bits(name: str) -> int:
    """Return the bits of a name's float: its hash, changed to avoid denormal, infinite and NaN values [Cry]."""
    bits = murmur3(name.encode())
    return bits ^ 1 << 23 if bits >> 23 & 255 in (0, 255) else bits


def matte_header(names: Sequence[str]) -> Mapping[str, str]:
    """Return the OpenEXR attributes for mattes of surfaces with these names."""
    key = f"cryptomatte/{murmur3(MATTES.encode()):08x}"[: len("cryptomatte/") + 7]
    manifest = {name: f"{matte_bits(name):08x}" for name in names}
    return {
        f"{key}/name": MATTES,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest),
    }


def matte_channels(coverage: npt.NDArray[np.float32], names: Sequence[str]) -> dict[str, npt.NDArray[np.float32]]:
    """Return the channels of the mattes.

    Args:
        coverage: (height, width, 2 n) number of a surface (-1: none) and its share in turn, as the layer ``coverage``.
        names: Names of the surfaces, by number.
    """
    hashes = np.array([*map(matte_bits, names), 0], np.uint32).view(np.float32)  # the last entry is for -1
    channels: dict[str, npt.NDArray[np.float32]] = {}
    for rank in range(coverage.shape[2] // 2):
        which, share = coverage[..., 2 * rank], coverage[..., 2 * rank + 1]
        layer = f"{MATTES}{rank // 2:02d}"
        for channel, values in zip("BA" if rank % 2 else "RG", (hashes[which.astype(int)], share), strict=True):
            channels[f"{layer}.{channel}"] = np.ascontiguousarray(values)
    return channels


def encode_picture(name: str, frame: LayerFrame) -> bytes:
    """Return the PNG of a layer of ``PICTURES``."""
    values = frame.layers[name]
    if name == "plate":
        picture: npt.NDArray[Any] = frame.frame
    elif name == "ids":
        picture = (values + 1).astype(np.uint16)
    elif name == "depth":
        steps = np.rint(values / DEPTH_STEP)
        picture = np.where(steps <= 65535.0, steps, 0.0).astype(np.uint16)
    else:
        picture = np.rint(32767.5 * (values + 1.0)).astype(np.uint16)
    return encode_png(picture)


class LayerSink(FolderSink):
    """A folder of ``NNNN.exr`` with the layers of each frame; with ``pictures`` also ``LAYER/NNNN.png``.

    Args:
        path: The folder.
        overwrite: True to replace numbered files that this program did not write.
        pictures: Names of layers to write as PNG, of ``PICTURES``.

    Raises:
        SinkError: A folder cannot be made or written to, or holds files that must not be replaced.
    """

    _suffix = ".exr"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False, pictures: tuple[str, ...] = ()) -> None:
        super().__init__(path, overwrite=overwrite)
        self._pictures = pictures
        for name in pictures:
            make_folder(self._path / name)
            self._find_earlier(self._path / name, ".png", overwrite=overwrite)

    def _check(self, image: Any) -> None:
        if not isinstance(image, LayerFrame):
            raise SinkError(f"layers of a frame are a LayerFrame, not {type(image).__name__}")

    def _store(self, index: int, image: Any) -> None:
        write_layers(self._path / f"{index:04d}.exr", image)
        for name in self._pictures:
            store(self._path / name / f"{index:04d}.png", encode_picture(name, image))


def parse_layers(text: str | None) -> tuple[str, ...]:
    """Return the names of layers in a comma-separated text; None or ``all`` means all layers.

    Raises:
        UsageError: A name is unknown, or there is none.
    """
    if text is None or text == "all":
        return tuple(LAYERS)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names or (text,):
        if name not in LAYERS:
            raise UsageError(f"--layers: {name!r} is no layer; {nearest(name, ['all', *LAYERS])}")
    return names


class SideFiles(Closing):
    """Folders with further outputs of every frame: the captured light, and the layers."""

    def __init__(
        self,
        *,
        environment: pathlib.Path | None = None,
        layers: pathlib.Path | None = None,
        names: tuple[str, ...] = tuple(LAYERS),
        pictures: bool = False,
        overwrite: bool = False,
    ) -> None:
        """Open the folders.

        Args:
            environment: Folder for the captured light of every frame; None: it is not written. Of several mirror balls
                whose light is interpolated, the first one's lies in it, those of the others in folders ``ball_1`` and
                so on below it.
            layers: Folder for layers; None: they are not written.
            names: Names of the layers.
            pictures: True to write layers that PNG can store as PNG as well.
            overwrite: True to replace numbered files that this program did not write.

        Raises:
            SinkError: A folder cannot be written to.
        """
        self._stack = contextlib.ExitStack()
        self.outputs: tuple[str, ...] = ()
        """Outputs that the pipeline's results must contain."""
        self._lights: list[EnvironmentSink] = []
        """Sinks of the captured light, one per mirror ball; all but the first are opened when needed."""
        self._environment, self._overwrite = environment, overwrite
        self._layers: LayerSink | None = None
        with contextlib.ExitStack() as stack:
            if environment is not None:
                self._lights.append(stack.enter_context(EnvironmentSink(environment, overwrite=overwrite)))
                self.outputs += ("environment",)
            if layers is not None:
                held = tuple(name for name in names if name in PICTURES) if pictures else ()
                self._layers = stack.enter_context(LayerSink(layers, overwrite=overwrite, pictures=held))
                self.outputs += names
            self._stack = stack.pop_all()

    @property
    def replaced(self) -> tuple[str, ...]:
        """Return a description of the files that the first frame replaces."""
        return tuple(sink.replaced for sink in (*self._lights[:1], self._layers) if sink and sink.replaced)

    @property
    def written(self) -> str:
        """Return a description of the stored files, beginning with a comma; empty without outputs."""
        lights = f", and {self._lights[0].written} environments" if self._lights else ""
        if len(self._lights) > 1:
            lights += f" of each of {len(self._lights)} mirror balls"
        return lights if self._layers is None else f"{lights}, and layers of {self._layers.written}"

    def write(self, frame: npt.NDArray[np.uint8], result: Result, scene: Scene) -> None:
        """Write the next frame.

        Args:
            frame: The camera's, uint8 RGB (height, width, 3).
            result: Result of the frame.
            scene: Scene as it was lit, with the camera at the frame's size.

        Raises:
            SinkError: An earlier frame could not be written.
        """
        if self._environment is not None and result.environment is not None:
            for ball, radiance in enumerate(result.environments):
                if ball == len(self._lights):
                    sink = EnvironmentSink(self._environment / f"ball_{ball}", overwrite=self._overwrite)
                    self._lights.append(self._stack.enter_context(sink))
                self._lights[ball].write(radiance)
        if self._layers is not None:
            self._layers.write(layer_frame(frame, result, scene))

    def close(self) -> None:
        """Close the folders."""
        self._stack.close()


def layer_frame(frame: npt.NDArray[np.uint8], result: Result, scene: Scene) -> LayerFrame:
    """Return a result's layers for a file; arguments are those of `SideFiles.write`."""
    camera = scene.camera.scaled_to(frame.shape[1], frame.shape[0])
    pose = result.pose
    return LayerFrame(
        result.layers,
        frame,
        surface_names(scene),
        result.exposure_scale,
        str(camera.transfer),
        None if pose is None else placement(pose.rotation, pose.translation),
        camera.matrix(),
    )
