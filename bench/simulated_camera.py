"""A camera with a real one's faults: what it makes of linear pictures, fault by fault or all together.

The order is that of the light: motion and lens before the sensor, the sensor before processing, that before the codec.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Sequence

import av
import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Faults:
    """What is wrong with a camera; each field's default is nothing."""

    distortion: float = 0.0
    """Radial distortion k1 of OpenCV; that a calibration knows it is the caller's affair."""
    motion_blur: float = 0.0
    """Pixels along a row over which a frame is smeared."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners."""
    exposure_drift: float = 0.0
    """Share by which the exposure swings to and fro over the clip."""
    white_balance_drift: float = 0.0
    """Share by which red rises while blue falls over the clip."""
    noise: float = 0.0
    """Standard deviation at full exposure, in linear values; shot noise, with a tenth of it as read noise."""
    s_curve: float = 0.0
    """Contrast added to sRGB's middle: 1 is a phone's."""
    sharpening: float = 0.0
    """Weight of the unsharp mask."""
    saturation: int = 255
    """Code at which the brightest light ends."""
    codec: str = ""
    """``mjpeg`` or ``h264``, both 4:2:0."""
    hand: bool = False
    """A hand passes over the picture in the middle third of the clip."""
    seed: int = 0
    """Of the noise."""


ALONE = {
    "none": Faults(),
    "s_curve": Faults(s_curve=1.0),
    "vignetting": Faults(vignetting=0.35),
    "distortion": Faults(distortion=-0.12),
    "noise": Faults(noise=0.02),
    "exposure_drift": Faults(exposure_drift=0.33),
    "white_balance_drift": Faults(white_balance_drift=0.15),
    "motion_blur": Faults(motion_blur=4.0),
    "sharpening": Faults(sharpening=0.8),
    "mjpeg": Faults(codec="mjpeg"),
    "h264": Faults(codec="h264"),
    "saturation_238": Faults(saturation=238),
    "hand": Faults(hand=True),
}
"""Each fault by itself."""
ALL = Faults(-0.12, 4.0, 0.35, 0.33, 0.15, 0.02, 1.0, 0.8, 238, "h264", True)
"""All of them together."""


def faults_named(name: str) -> Faults:
    """The faults of a name: one of ``ALONE``, ``all``, or ``all_but_NAME``, which leaves one of them out.

    Raises:
        KeyError: If there is no such fault.
    """
    if name == "all":
        return ALL
    if name in ALONE:
        return ALONE[name]
    left_out = ALONE[name.removeprefix("all_but_")]
    fields = [field for field in dataclasses.fields(Faults) if getattr(left_out, field.name) != field.default]
    return dataclasses.replace(ALL, **{field.name: field.default for field in fields})


def decode_srgb(codes: NDArray[np.uint8]) -> Array:
    """Linear values of codes."""
    c = codes / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _encode(light: Array, contrast: float) -> Array:
    x = np.clip(light, 0.0, 1.0)
    code = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    # Zero at both ends and in the middle; it falls below there and rises above.
    return np.asarray(code + 0.9 * contrast * code * (1.0 - code) * (code - 0.45), float)


def _lens(light: Array, faults: Faults) -> Array:
    """Smear, bend and darken; the lens is centred, its focal length the picture's width."""
    if faults.motion_blur > 1.0:
        length = faults.motion_blur
        kernel = np.clip(0.5 * length + 0.5 - np.abs(np.arange(-int(length), int(length) + 1)), 0.0, 1.0)
        light = cv2.filter2D(light, -1, (kernel / kernel.sum())[None], borderType=cv2.BORDER_REPLICATE)
    height, width = light.shape[:2]
    y, x = (np.mgrid[:height, :width] - np.array([height - 1, width - 1])[:, None, None] / 2) / width
    if faults.distortion:
        # Where a distorted pixel's light comes from: the inverse of OpenCV's model, by fixed points.
        ux, uy = x.copy(), y.copy()
        for _ in range(8):
            factor = 1.0 + faults.distortion * (ux * ux + uy * uy)
            ux, uy = x / factor, y / factor
        at = ((c * width + (n - 1) / 2).astype(np.float32) for c, n in ((ux, width), (uy, height)))
        light = cv2.remap(light.astype(np.float32), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(float)
    corner = 0.25 * (1.0 + (height / width) ** 2)
    return np.asarray(light * (1.0 - faults.vignetting * (x * x + y * y) / corner)[..., None])


def expose(frames: Sequence[Array], faults: Faults, *, phase: Sequence[float] | None = None) -> list[Image]:
    """Pictures that a camera with ``faults`` makes of linear ones.

    Args:
        frames: Linear RGB, (height, width, 3) each; 1 clips where nothing drifts.
        faults: Of the camera.
        phase: Where in the clip each frame lies, 0 to 1; evenly spaced if None.
    """
    phase = np.linspace(0.0, 1.0, len(frames)) if phase is None else np.asarray(phase)
    random = np.random.default_rng(faults.seed)
    pictures = []
    for light, when in zip(frames, phase, strict=True):
        swing = np.sin(2 * np.pi * when)
        gain = (1.0 + faults.exposure_drift * swing) * (1.0 + faults.white_balance_drift * np.array([1, 0, -1]) * when)
        seen = np.array(light, float)
        if faults.hand and 1 / 3 < when < 2 / 3:
            left = int((3 * when - 1) * seen.shape[1])
            seen[:, max(left - seen.shape[1] // 6, 0) : left] = np.array([0.35, 0.2, 0.14])
        seen = _lens(seen, faults) * gain
        if faults.noise:
            spread = faults.noise * np.sqrt(np.clip(seen, 0.0, 1.0) + 0.01)
            seen = seen + spread * random.normal(size=seen.shape)
        code = _encode(seen, faults.s_curve)
        if faults.sharpening:
            code = code + faults.sharpening * (code - cv2.GaussianBlur(code, (0, 0), 1.2))
        pictures.append(np.round(np.clip(code, 0.0, 1.0) * faults.saturation).astype(np.uint8))
    if faults.codec == "mjpeg":
        return [_jpeg(picture) for picture in pictures]
    return _h264(pictures) if faults.codec == "h264" else pictures


def _jpeg(picture: Image) -> Image:
    flags = [cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, data = cv2.imencode(".jpg", picture[..., ::-1], flags)
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def _h264(pictures: Sequence[Image]) -> list[Image]:
    """Through an H.264 stream, 4:2:0, as a recorder writes it, which does not look ahead over macroblocks (``mbtree``).

    With that the same pictures became other streams from run to run.
    """
    file = io.BytesIO()
    height, width = pictures[0].shape[:2]
    with av.open(file, "w", format="mp4") as container:
        options = {"crf": "23", "preset": "veryfast", "x264-params": "mbtree=0"}
        stream = container.add_stream("libx264", rate=24, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    file.seek(0)
    with av.open(file) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
