"""Captured light: an environment in a file, for lighting other pictures than those it was captured from.

The file is an OpenEXR latlong with channels R, G, B and ``confidence`` (1: seen; 0: filled from neighbours). R, G, B
are camera values: linear values of the shown exposure, in which the camera clips at 1. Its attributes are:

- ``axes``, ``chromaticities``;
- ``whiteLevel``: value at which the camera clipped;
- ``exposure``: t ISO / (100 N^2); 0 if unknown;
- ``lowerBound``: share of the light that is a lower bound, because it clips in the shortest exposure;
- ``emitters``: bright sources, as JSON;
- ``cameraColors``, if a colour chart gave the colours: matrix (3x3) from the file's RGB, which is then Rec. 709, to
  camera values.

A file of another program lacks these attributes. `exr_file.read_linear_picture` converts its values, and
`latlong_axes.axes_of` finds its axes.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from warp_ar.declared import check_fields, checked
from warp_ar.errors import SceneError, SinkError, UsageError, reason
from warp_ar.exr_file import read_exr_header, read_linear_picture, write_exr
from warp_ar.files import parse_json, write_whole
from warp_ar.light.latlong_axes import DESCRIPTIONS, axes_of, from_axes, to_axes, world_from_marker
from warp_ar.signals import REC_709

Array = NDArray[np.float64]
Map = NDArray[np.float32]

BRIGHT = 6.0
"""Ratio of a texel's radiance to the map's mean above which the texel is part of an emitter."""
MOST_EMITTERS = 12
"""Largest number of emitters that are found."""
LEAST_SHARE = 0.01
"""Smallest share of an emitter in the light from all directions."""


@dataclasses.dataclass(frozen=True)
class CapturedEmitter:
    """Bright source in captured light, whose light the map includes as well."""

    direction: tuple[float, float, float]
    """Unit vector from ``origin``."""
    solid_angle: float
    """Solid angle, steradians."""
    power: tuple[float, float, float]
    """Radiance times solid angle, RGB."""
    low: tuple[float, float, float]
    """Lower end of the power's interval."""
    high: tuple[float, float, float] | None
    """Upper end of the power's interval; None if the emitter clips in every exposure."""
    distance: float | None = None
    """Distance from ``origin`` in metres; None: as distant as the environment."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point from which direction and distance are measured, metres."""


@dataclasses.dataclass(frozen=True)
class Light:
    """Light of an environment, with its confidence, its emitters and its limits."""

    radiance: Map
    """Linear RGB, float32 (height, 2 height, 3), in camera values of the shown photograph's exposure."""
    confidence: Map
    """Confidence of each texel, 0 to 1, float32 (height, 2 height)."""
    emitters: tuple[CapturedEmitter, ...] = ()
    """Bright sources, most powerful first."""
    white_level: float = 1.0
    """Value at which the capture's camera clipped."""
    exposure: float | None = None
    """Exposure t ISO / (100 N^2) that was shown; None if unknown."""
    lower_bound: float = 0.0
    """Share of the light that is a lower bound, 0 to 1."""
    colors: tuple[float, ...] | None = None
    """Matrix from the light's RGB to camera values, row by row, if a colour chart gave it; None: it has camera
    values."""

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UsageError: A map has another shape or a number that is not finite, or a number is out of its range.
        """
        check_fields(self)
        for name, components in (("radiance", (3,)), ("confidence", ())):
            values = getattr(self, name)
            if values.shape != (len(values), 2 * len(values), *components) or len(values) < 2:
                right = "expected (height, 2 height, 3)" if components else "expected (height, 2 height)"
                raise UsageError(f"Light: {name} has the shape {values.shape}; {right}")
            if values.dtype.kind != "f" or not np.isfinite(values).all():
                raise UsageError(f"Light: {name} of {values.dtype}: expected finite floats")
        for name, most in (("white_level", math.inf), ("exposure", math.inf), ("lower_bound", 1.0 + 1e-6)):
            if not 0.0 <= (getattr(self, name) or 0.0) <= most:
                raise UsageError(f"Light: {name} = {getattr(self, name)}: expected a number from 0 to {most:g}")

    def recolored(self, matrix: Array) -> Light:
        """Return the light with its colours multiplied by a matrix (3, 3); values below 0 become 0."""

        def changed(value: Any) -> Any:
            return np.maximum(value @ matrix.T, 0.0)

        emitters = []
        for emitter in self.emitters:
            powers = ((name, getattr(emitter, name)) for name in ("power", "low", "high"))
            told: dict[str, Any] = {name: _triple(changed(power)) for name, power in powers if power is not None}
            emitters.append(dataclasses.replace(emitter, **told))
        radiance = np.asarray(changed(self.radiance), np.float32)
        return dataclasses.replace(self, radiance=radiance, emitters=tuple(emitters))

    @checked
    def save(self, path: str | Path, axes: str = "z-up") -> None:
        """Write the light as OpenEXR.

        Args:
            path: The file.
            axes: Axes of the file, one of ``latlong_axes.AXES``.

        Raises:
            SinkError: The file cannot be written.
            UsageError: There are no such axes.
        """
        path = Path(path)
        radiance, confidence = to_axes(self.radiance, axes), to_axes(self.confidence, axes)
        emitters = tuple(_turned(emitter, world_from_marker(axes)) for emitter in self.emitters)
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "software": "warp_ar",
            "axes": DESCRIPTIONS[axes],
            "chromaticities": REC_709,
            "whiteLevel": float(self.white_level),
            "exposure": float(self.exposure or 0.0),
            "lowerBound": float(self.lower_bound),
            "emitters": json.dumps([dataclasses.asdict(emitter) for emitter in emitters]),
        }
        if self.colors is not None:
            header["cameraColors"] = np.reshape(self.colors, (3, 3)).astype(np.float32)
        channels = {"RGB": np.ascontiguousarray(radiance), "confidence": np.ascontiguousarray(confidence)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda part: write_exr(part, OpenEXR.File(header, channels)))
        except (RuntimeError, OSError, ValueError) as error:
            raise SinkError(f"{path} cannot be written: {reason(error)}") from error

    @classmethod
    @checked
    def load(cls, path: str | Path, axes: str | None = None) -> Light:
        """Read a captured light, or any latlong OpenEXR or Radiance HDR.

        Args:
            path: The file.
            axes: One of ``latlong_axes.AXES``; None: the axes that the file states, or else those of its format.

        Raises:
            SceneError: The file cannot be used.
        """
        path = Path(path)
        picture = read_linear_picture(path, SceneError, str(path))
        height, width = picture.color.shape[:2]
        if width != 2 * height or height < 2:
            raise SceneError(f"{path} is {width}x{height}: a latlong environment is twice as wide as high")
        axes = axes_of(picture, path, axes, SceneError, str(path))
        radiance = np.clip(picture.color, 0.0, 1e6)  # some published files have negative pixels
        header = picture.header
        confidence = np.clip(picture.others.get("confidence", np.ones((height, width), np.float32)), 0.0, 1.0)
        emitters = _parse_emitters(path, header.get("emitters", "[]"))
        colors = header.get("cameraColors")
        if colors is not None and not (np.shape(colors) == (3, 3) and np.isfinite(colors).all()):
            raise SceneError(f"{path}: its attribute cameraColors is {str(colors)[:40]!r}; expected 3x3 finite numbers")
        if axes != "z-up":
            radiance, confidence = (from_axes(channel, axes) for channel in (radiance, confidence))
            emitters = tuple(_turned(emitter, world_from_marker(axes).T) for emitter in emitters)
        return cls(
            radiance,
            confidence,
            emitters,
            _attribute(path, header, "whiteLevel", 1.0),
            _attribute(path, header, "exposure", 0.0) or None,
            min(_attribute(path, header, "lowerBound", 0.0), 1.0),
            None if colors is None else tuple(map(float, np.ravel(colors))),
        )

    def resampled(self, height: int, rotation: Array | None = None) -> Map:
        """Return the map at another size and in rotated axes, (height, 2 height, 3).

        Args:
            height: Rows of the result.
            rotation: Rotation from the light's axes to those of the result, (3, 3).
        """
        source = self.radiance
        if source.shape[0] > height:
            source = cv2.resize(source, (2 * height, height), interpolation=cv2.INTER_AREA)
        if rotation is None or np.allclose(rotation, np.eye(3)):
            if source.shape[0] == height:
                return np.ascontiguousarray(source)
            rotation = np.eye(3)
        rows, columns = source.shape[:2]
        # A map continues beyond a pole on its opposite side, and beyond its right edge at the left one.
        poles = [np.roll(source[row : row + 1], columns // 2, 1) for row in (0, rows - 1)]
        wide = np.concatenate([poles[0], source, poles[1]], 0)
        wide = np.concatenate([wide[:, -1:], wide, wide[:, :2]], 1)
        total = np.zeros((height, 2 * height, 3), np.float32)
        for dy in (0.25, 0.75):
            for dx in (0.25, 0.75):
                d = latlong_directions(height, dy, dx) @ rotation  # applies the inverse rotation to each direction
                y = np.arccos(np.clip(d[..., 2], -1.0, 1.0)) / math.pi * rows - 0.5
                x = (np.arctan2(d[..., 1], d[..., 0]) / (2 * math.pi) + 0.5) * columns - 0.5
                total += cv2.remap(
                    wide, (np.mod(x, columns) + 1.0).astype(np.float32), (y + 1.0).astype(np.float32), cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )  # fmt: skip
        return np.ascontiguousarray(total / 4.0)


def latlong_directions(height: int, dy: float = 0.5, dx: float = 0.5) -> Array:
    """Return the unit direction of a point in each texel of a latlong map with z up, (height, 2 height, 3).

    Args:
        height: Rows of the map.
        dy: Distance of the point from the texel's upper edge, in texels.
        dx: Distance of the point from the texel's left edge, in texels.
    """
    theta = (np.arange(height) + dy)[:, None] * (math.pi / height)
    phi = (np.arange(2 * height) + dx)[None, :] * (math.pi / height) - math.pi
    s = np.sin(theta)
    return np.stack([s * np.cos(phi), s * np.sin(phi), np.cos(theta) + 0.0 * phi], -1)


def texel_solid_angles(height: int) -> Array:
    """Return the solid angle in steradians of a texel in each row of a latlong map, (height, 1)."""
    edges = np.cos(np.arange(height + 1) * math.pi / height)
    return np.asarray((edges[:-1] - edges[1:])[:, None] * (math.pi / height))


def irradiance_above(radiance: Map) -> Array:
    """Return the irradiance, (3,), of a horizontal plane under a latlong map with z up, (height, 2 height, 3)."""
    height = len(radiance)
    weight = np.maximum(latlong_directions(height)[..., 2:], 0.0) * texel_solid_angles(height)[..., None]
    return np.asarray((weight * radiance).sum((0, 1)), float)


def find_emitters(
    radiance: Map, clipped: Map, error: float, captured: Map | None = None
) -> tuple[CapturedEmitter, ...]:
    """Return at most ``MOST_EMITTERS`` bright sources of a map, the most powerful first.

    A source is a connected set of texels that are brighter than ``BRIGHT`` times the map's mean, or more than half
    clipped in a channel. Sources with less than ``LEAST_SHARE`` of the map's light are left out.

    Args:
        radiance: Latlong map, (height, 2 height, 3), with estimated radiance where it clips.
        clipped: Share of each texel that clips in every exposure, by channel, (height, 2 height, 3).
        error: Relative error of radiance that does not clip; sets the width of the powers' intervals.
        captured: Map with clipped radiance as captured, from which the lower ends of the intervals are computed;
            None: ``radiance``.
    """
    captured = radiance if captured is None else captured
    height = len(radiance)
    area = np.broadcast_to(texel_solid_angles(height), radiance.shape[:2])
    gray = radiance.mean(2)
    total = float((gray * area).sum())
    bright = (gray > BRIGHT * total / (4 * math.pi)) | (clipped.max(2) > 0.5)
    count, labels = cv2.connectedComponents(bright.astype(np.uint8), connectivity=8)
    # The map's left and right edges are adjacent.
    for a, b in zip(labels[:, 0], labels[:, -1], strict=True):
        if a and b and a != b:
            labels[labels == b] = a
    directions = latlong_directions(height)
    found = []
    for label in range(1, count):
        inside = labels == label
        light = radiance[inside] * area[inside][:, None]
        power = light.sum(0).astype(float)
        least = (captured[inside] * area[inside][:, None]).sum(0).astype(float)
        if not power.any() or power.mean() < LEAST_SHARE * total:
            continue
        toward = (directions[inside] * light.mean(1)[:, None]).sum(0)
        toward /= max(float(np.linalg.norm(toward)), 1e-12)
        clips = clipped[inside].max() > 0.0
        low, high = _triple(least * (1 - error)), None if clips else _triple(power * (1 + error))
        found.append(CapturedEmitter(_triple(toward), float(area[inside].sum()), _triple(power), low, high))
    return tuple(sorted(found, key=lambda emitter: -sum(emitter.power))[:MOST_EMITTERS])


def _triple(values: Sequence[float] | Array) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 6) for v in values)
    return x, y, z


def _attribute(path: Path, header: Mapping[str, Any], name: str, default: float) -> float:
    value = header.get(name, default)
    number = float(value) if isinstance(value, numbers.Real) else math.nan
    if not 0.0 <= number < math.inf:
        raise SceneError(f"{path}: its attribute {name} is {str(value)[:40]!r}; expected a finite number, 0 or more")
    return number


def _turned(emitter: CapturedEmitter, rotation: Array) -> CapturedEmitter:
    direction, origin = (_triple(rotation @ np.array(value)) for value in (emitter.direction, emitter.origin))
    return dataclasses.replace(emitter, direction=direction, origin=origin)


def has_places(path: str | Path) -> bool:
    """Return True if a captured light has an emitter of known distance; False also if the file cannot be read."""
    path = Path(path)
    if path.suffix.lower() == ".hdr":
        return False
    try:
        header = read_exr_header(path, SceneError, str(path))
        return any(emitter.distance is not None for emitter in _parse_emitters(path, header.get("emitters", "[]")))
    except SceneError:
        return False  # the error is reported when the light is read


def placed_emitters(
    emitters: Sequence[CapturedEmitter], scale: float = 1.0, rotation: Array | None = None
) -> NDArray[Any]:
    """Return records of ``kernels.structs.Emitter`` for the emitters of known distance.

    Args:
        emitters: Emitters of a light.
        scale: Factor to the camera values of the frames.
        rotation: Rotation from the light's axes to the scene's, (3, 3); None: the axes are the same.
    """
    from warp_ar.kernels.structs import Emitter, struct_dtype  # imported here: the page is served before Warp is loaded

    turn = np.eye(3) if rotation is None else rotation
    placed = [emitter for emitter in emitters if emitter.distance is not None]
    records = np.zeros(len(placed), struct_dtype(Emitter))
    for record, emitter in zip(records, placed, strict=True):
        record["origin"], record["direction"] = turn @ np.array(emitter.origin), turn @ np.array(emitter.direction)
        record["distance"], record["power"] = emitter.distance, scale * np.array(emitter.power)
    return records


def _parse_emitters(path: Path, text: object) -> tuple[CapturedEmitter, ...]:
    label = f"{path}: its attribute emitters"
    entries = parse_json(str(text), label, SceneError)
    try:
        emitters = tuple(
            CapturedEmitter(
                _triple(entry["direction"]),
                float(entry["solid_angle"]),
                _triple(entry["power"]),
                _triple(entry["low"]),
                None if entry["high"] is None else _triple(entry["high"]),
                None if entry["distance"] is None else float(entry["distance"]),
                _triple(entry["origin"]),
            )
            for entry in entries
        )
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise SceneError(f"{label} is damaged: {reason(error)}") from error
    for emitter in emitters:
        given = [*emitter.direction, emitter.solid_angle, *emitter.power, *emitter.low, *emitter.origin]
        given += [*(emitter.high or ()), emitter.distance or 0.0]
        if not all(map(math.isfinite, given)):
            raise SceneError(f"{label} is damaged: it holds a number that is not finite")
    return emitters
