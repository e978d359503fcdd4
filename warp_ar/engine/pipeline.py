"""The library's face: a scene, a device and a quality make a pipeline; call it with frames."""

from __future__ import annotations

import collections
import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive, resolve_device, translating
from warp_ar.engine.frame_block import FrameBlock
from warp_ar.engine.graph import make_plan
from warp_ar.engine.modules import Progress
from warp_ar.engine.scheduler import Scheduler, StageTiming
from warp_ar.engine.short_frames import ShortFrames
from warp_ar.engine.transfer import Image, Picture, Slot, Transfers
from warp_ar.errors import UsageError
from warp_ar.input.exposures import bracket_ratios, brightened, find_exposure
from warp_ar.input.tracking import Tracker, TrackState
from warp_ar.kernels.color import decode_table, encode_table
from warp_ar.kernels.structs import Probe
from warp_ar.scene import Pose, Scene
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.scene.ray_scene import HostScene, Outline, Rect, screen_rects, skeleton
from warp_ar.stages.base import Arrays, Request, Rows
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS, Quality

LIGHT_ARRAYS = ("environment_radiance", "environment_confidence", "environment_clipped")
"""What is remembered of the environment from frame to frame."""

TRACK = "track"
"""Name of the host's own stage in reports: the marker's pose."""

AHEAD = 2
"""Submitted frames that may wait for being rendered."""

RECTS = ("object", "light", "shadow", "ball")
"""Parts of the screen to whose rows passes keep; the frame's values hold them whole."""

DEFAULT_FRAME_INTERVAL = 1.0 / 30.0
"""Seconds between frames whose caller gives no time."""


@dataclasses.dataclass(frozen=True)
class Rendered:
    """What the stages made of one frame."""

    image_array: Any
    environment_array: Any
    stages: Mapping[str, StageTiming]
    render_ms: float = 0.0
    """Of the host: running the stages on CPU, launching them on CUDA."""
    image: Picture | Image | None = None
    """The picture, or that it is on its way to the host, where it was sent ahead."""
    environment: npt.NDArray[np.float32] | None = None
    """The environment where it was kept."""


@dataclasses.dataclass(frozen=True)
class Result:
    """What one frame became; of a frame that was submitted, all but the pose waits until it has been rendered."""

    pose: Pose | None
    """From marker to camera; None while the marker is lost or when nothing needed it."""
    state: TrackState | None
    """Tracked, held or lost; None when nothing needed the pose."""
    _rendered: Future[Rendered]
    shown: bool = True
    """False: the frame has another exposure than the shown ones; it only told of the light, the picture is the last."""

    @property
    def image_array(self) -> Any:
        """The lit frame, (height, width) of 8-bit RGB, on the pipeline's device; valid until the next call."""
        return self._rendered.result().image_array

    @property
    def environment_array(self) -> Any:
        """The environment, latlong linear RGB (rows, columns), or None if it was not asked for or not seen yet."""
        return self._rendered.result().environment_array

    @property
    def stages(self) -> Mapping[str, StageTiming]:
        """Milliseconds of every stage of the plan, and whether it was skipped."""
        return self._rendered.result().stages

    @property
    def steps(self) -> Mapping[str, float]:
        """Milliseconds of the steps of the frame's way, which overlap those of other frames.

        ``track`` and ``render`` (on CUDA: launching) on the host; of a frame that was submitted on CUDA also
        ``upload``, ``kernels`` and ``download``, on the device.
        """
        rendered = self._rendered.result()
        tracking = rendered.stages.get(TRACK)
        steps = {TRACK: tracking.milliseconds} if tracking is not None else {}
        steps["render"] = rendered.render_ms
        return steps | rendered.image.steps() if isinstance(rendered.image, Picture) else steps

    @functools.cached_property
    def image(self) -> Image:
        """The lit frame as a NumPy array of its own, uint8 RGB (height, width, 3)."""
        rendered = self._rendered.result()
        if rendered.image is not None:
            return rendered.image.result() if isinstance(rendered.image, Picture) else rendered.image
        lit = rendered.image_array
        if not isinstance(lit, wp.array):
            return np.array(lit)
        with exclusive(lit.device):
            return np.array(lit.numpy())

    @functools.cached_property
    def environment(self) -> npt.NDArray[np.float32] | None:
        """The environment as a NumPy array of its own, float32 RGB (rows, columns, 3)."""
        rendered = self._rendered.result()
        if rendered.environment is not None or rendered.environment_array is None:
            return rendered.environment
        with exclusive(rendered.environment_array.device):
            return np.array(rendered.environment_array.numpy())


@dataclasses.dataclass(frozen=True)
class _Frame:
    """A frame that has been looked at, not rendered."""

    image: Any
    """As it was given, or a copy of one's own."""
    slot: Slot | None
    """Its way to the device, where that has begun."""
    pose: Pose | None
    lost: bool
    index: int
    time: float
    """Seconds, by the caller's clock."""
    seconds: float
    """Since the first frame."""
    step: float
    """Seconds since the frame before that was lit."""
    timings: dict[str, StageTiming]


def resolve_quality(quality: str | Quality) -> Quality:
    """Quality value for a preset's name.

    Raises:
        UsageError: No preset has that name.
    """
    if isinstance(quality, Quality):
        return quality
    if quality not in PRESETS:
        raise UsageError(f"quality {quality!r} is no preset; expected {', '.join(PRESETS)}")
    return PRESETS[quality]


class Pipeline:
    """Lights frames: call it with one frame after another of one camera.

    Arrays are allocated here, never while frames run.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        device: str = "auto",
        quality: str | Quality = DEFAULT_PRESET,
        size: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("image",),
        exposures: Sequence[float] = (),
        bands: int | None = None,
        profile: bool = False,
        waits: bool = False,
    ) -> None:
        """Plan, allocate and build.

        Args:
            scene: What to show.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name or a value of one's own.
            size: Width and height of the frames; None means the scene's. Another must scale the scene's camera exactly.
            outputs: What results shall hold: ``image``, ``environment``, ``pose``.
            exposures: Exposure times in seconds between which the frames alternate. Frames of the longest are lit and
                shown; the others tell what clips in it.
            bands: Bands of rows per CPU pass; None means one per core.
            profile: On CUDA wait for every frame and time each stage on the device.
            waits: Whether a frame waits for the light that is estimated from it. A camera's frames should not: that
                light then takes effect some frames later.

        Raises:
            UsageError: An argument that cannot be used.
            SceneError: The scene's camera does not fit ``size``.
        """
        self.device = resolve_device(device)
        self.camera = scene.camera if size is None else scene.camera.scaled_to(*size)
        self.scene = dataclasses.replace(scene, camera=self.camera)
        self.size = (self.camera.width, self.camera.height)
        self.quality = resolve_quality(quality)
        self._longest = max(exposures, default=1.0)
        ratios = bracket_ratios(exposures)
        self.plan = make_plan(Request(self.scene, self.quality, self.size, outputs, ratios, waits))
        self._tracker = Tracker(self.scene.marker, self.camera) if self.plan.needs("pose") else None
        self._start_time: float | None = None
        self._last_time = 0.0
        self._lit_time = 0.0
        self._index = 0
        self._shown: Any = None
        self._has_light = False
        self._arrays = Arrays()
        self._short: ShortFrames | None = None
        self._renderer: ThreadPoolExecutor | None = None
        self._ahead: collections.deque[Future[Rendered]] = collections.deque()
        with translating(self.device), wp.ScopedDevice(self.device):
            self._add_inputs()
            self._scheduler = Scheduler(self.plan, self._arrays, self.device, bands=bands, profile=profile)
            if self.plan.needs("short_frames"):
                self._short = ShortFrames(self.plan.request, self._arrays, self.device)

    def __enter__(self) -> Pipeline:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the worker threads; arrays go when the last result that refers to them does."""
        if self._renderer is not None:
            self._renderer.shutdown()
        if self._transfers is not None:
            self._transfers.close()
        self._scheduler.close()

    @property
    def scheduler(self) -> Scheduler:
        """What runs the stages and times them."""
        return self._scheduler

    @property
    def arrays(self) -> Arrays:
        """Every named array of the pipeline, on its device."""
        return self._arrays

    def _add_inputs(self) -> None:
        width, height = self.size
        device = self.device
        self._host_scene = HostScene(self.scene, device)
        self._block = FrameBlock(device, len(self.scene.lights), len(self.scene.objects))
        self._host_scene.ray_scene.objects = self._block.device_array("objects")
        self._frame = wp.zeros((height, width), dtype=wp.vec3ub, device=device)
        self._transfers = None if device.is_cpu else Transfers((height, width), device)
        add = self._arrays.add
        for name in ("pose", "lights", "objects", "exposure", "clock", "short_frames"):
            add(name, None)
        add("frame", self._frame)
        add("params", self._block.device_array("params"))
        add("light_array", self._block.device_array("lights"))
        add("ray_scene", self._host_scene.ray_scene)
        add("probes", wp.array(self._probe_values(), dtype=Probe, device=device))
        self._decode = decode_table(self.camera.transfer)
        add("decode", wp.array(self._decode, dtype=wp.vec3, device=device))
        add("encode", wp.array(encode_table(self.camera.transfer), dtype=wp.vec3, device=device))
        add("rays", wp.array(pixel_rays(self.camera), dtype=wp.vec2, device=device))
        self._rects: dict[str, Rect] = dict.fromkeys(RECTS, (0, height, 0, width))
        for name in RECTS:
            add(f"{name}_rows", functools.partial(self._rows, name))
        # Views of every field, (1, ...): NumPy takes longer to find a field than to write it.
        values = self._block.host("params")
        params = self._params = {name: values[name] for name in values.dtype.names}
        add("seconds", lambda: float(params["time"][0]))
        params["focal"][0] = (self.camera.fx, self.camera.fy)
        params["principal"][0] = (self.camera.cx, self.camera.cy)
        params["distortion"][0] = np.resize(np.asarray([*self.camera.distortion, *([0.0] * 8)], np.float32), 8)
        self._write_exposure(self.scene)

    def update(self, scene: Scene) -> bool:
        """Show another scene from the next frame on, if it differs in numbers alone.

        Positions, sizes, colours, intensities, the values of materials and the scale of the exposure are numbers. What
        adds or drops a stage or calls for another kernel is not: build a new pipeline, which can ``continue_from`` this
        one.

        Args:
            scene: The new scene; its camera is scaled as it was in the constructor.

        Returns:
            False if the scene needs a new pipeline; nothing has changed then.

        Raises:
            SceneError: The scene's camera does not fit the size of the frames.
        """
        self._finish()
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(*self.size))
        request = dataclasses.replace(self.plan.request, scene=scene)
        if skeleton(scene) != skeleton(self.scene):
            return False
        plan = make_plan(request)
        if plan.stages != self.plan.stages:
            return False
        if scene.exposure != self.scene.exposure:
            self._write_exposure(scene)
        if scene.objects != self.scene.objects or scene.lights != self.scene.lights:
            with exclusive(self.device):
                self._host_scene.update(scene)
            self._arrays.touch("objects")
        self.scene, self.plan = scene, plan
        return True

    def warm_up(self, progress: Progress | None = None) -> None:
        """Load every kernel, so that the first frame takes no longer than others; may run beside another pipeline.

        Args:
            progress: Called with how many of how many modules are compiled, first with 0, if any must be: kernels are
                compiled once for a kind of scene and kept. On the caller's thread.
        """
        self._scheduler.warm_up(progress)

    def continue_from(self, other: Pipeline) -> None:
        """Go on where another pipeline stopped: its clock and, where they fit, its track and its light."""
        self._finish()
        other._finish()
        self._start_time, self._last_time, self._lit_time = other._start_time, other._last_time, other._lit_time
        self._shown = other._shown
        if (self.scene.marker, self.camera) == (other.scene.marker, other.camera) and other._tracker and self._tracker:
            self._tracker = other._tracker
        with exclusive(self.device):
            self._take_light(other)
            self._scheduler.continue_from(other._scheduler)
        if self._short is not None and other._short is not None:
            self._short.resume(other._short)

    def _take_light(self, other: Pipeline) -> None:
        kept = [name for name in LIGHT_ARRAYS if name in self._arrays and name in other._arrays]
        if other._has_light and kept:
            if self._arrays[kept[0]].shape == other._arrays[kept[0]].shape:
                for name in kept:
                    wp.copy(self._arrays[name], other._arrays[name])
            else:
                radiance, confidence, clipped = (other._arrays[name].numpy() for name in LIGHT_ARRAYS)
                light = resample_light(radiance, confidence, clipped, self._arrays[kept[0]].shape)
                for name, values in zip(LIGHT_ARRAYS, light, strict=True):
                    self._arrays[name].assign(values)
            self._has_light = True

    def _write_exposure(self, scene: Scene) -> None:
        scale = scene.exposure.scale
        self._params["exposure_scale"][0] = 1.0 if isinstance(scale, str) else scale
        self._arrays.touch("exposure")

    def _probe_values(self) -> npt.NDArray[Any]:
        values = np.zeros(len(self.scene.probes), dtype=np.dtype(Probe.numpy_dtype()))
        for value, probe in zip(values, self.scene.probes, strict=True):
            value["center"], value["radius"], value["reflectance"] = probe.center, probe.radius, probe.reflectance
        return values

    def submit(
        self,
        image: npt.NDArray[np.uint8] | Any,
        *,
        time_seconds: float | None = None,
        pose: Pose | None = None,
        exposure_time: float | None = None,
    ) -> Result:
        """Light one frame without waiting for it; arguments as those of a call.

        This thread looks for the marker and hands the frame over; another renders it, and on CUDA sends its picture
        ahead. With the next frame submitted before this one's image is read, tracking, both ways over the bus and the
        kernels run side by side. The device's own arrays of a result still hold only until the next frame is rendered.
        """
        host_image = self._accept(image)
        now, exposure = self._note_time(time_seconds, exposure_time)
        if exposure > 0:
            return self._take_short(image, host_image, exposure, now, pose)
        if host_image is None:
            self._finish()
            frame, state = self._look(image, None, now, pose)
            return Result(frame.pose, state, _done(self._keep(self._render(frame))))
        frame, state = self._look(host_image, host_image, now, pose)
        while len(self._ahead) >= AHEAD:
            self._ahead.popleft().result()
        if self._renderer is None:
            self._renderer = ThreadPoolExecutor(1, "warp_ar-render")
        # The caller may write its picture anew before it is rendered.
        if self._transfers is None or frame.lost or "image" not in self._arrays:
            frame = dataclasses.replace(frame, image=host_image.copy())
        if self._transfers is not None and not frame.lost:
            frame = dataclasses.replace(frame, slot=self._transfers.upload(host_image))
        self._ahead.append(self._renderer.submit(lambda: self._keep(self._render(frame))))
        return Result(frame.pose, state, self._ahead[-1])

    def _finish(self) -> None:
        """Wait until all that was submitted is rendered."""
        while self._ahead:
            self._ahead.popleft().result()

    def _keep(self, rendered: Rendered) -> Rendered:
        """Have the picture outlast the next frame."""
        lit, light = rendered.image_array, rendered.environment_array
        if not isinstance(lit, wp.array):
            return dataclasses.replace(rendered, image=lit)
        if self._transfers is not None:
            return dataclasses.replace(rendered, image=self._transfers.download(lit))
        kept = None if light is None else np.array(light.numpy())
        return dataclasses.replace(rendered, image=np.array(lit.numpy()), environment=kept)

    def __call__(
        self,
        image: npt.NDArray[np.uint8] | Any,
        *,
        time_seconds: float | None = None,
        pose: Pose | None = None,
        exposure_time: float | None = None,
    ) -> Result:
        """Light one frame.

        Args:
            image: uint8 RGB, a NumPy array (height, width, 3), or a Warp array (height, width) of ``wp.vec3ub`` on the
                pipeline's device, which is used without a copy to the host unless the marker must be found.
            time_seconds: When the frame was taken; frames without a time are taken to come 30 times a second.
            pose: ``camera_from_world`` where it is known from elsewhere; the marker is then not looked for.
            exposure_time: Seconds; None means the longest of the pipeline's exposures.

        Raises:
            UsageError: The image has another size or type.
        """
        host_image = self._accept(image)
        self._finish()
        now, exposure = self._note_time(time_seconds, exposure_time)
        if exposure > 0:
            return self._take_short(image, host_image, exposure, now, pose)
        frame, state = self._look(image, host_image, now, pose)
        if host_image is not None and not frame.lost and self._transfers is not None:
            frame = dataclasses.replace(frame, slot=self._transfers.upload(host_image))
        return Result(frame.pose, state, _done(self._render(frame)))

    def _note_time(self, time_seconds: float | None, exposure_time: float | None) -> tuple[float, int]:
        """When a frame was taken, and which of the exposures it has."""
        now = self._last_time + DEFAULT_FRAME_INTERVAL if time_seconds is None else time_seconds
        if self._start_time is None:
            self._start_time = self._last_time = self._lit_time = now
        return now, find_exposure(exposure_time, self._longest, self.plan.request.exposures)

    def _look(
        self, image: Any, host_image: Image | None, now: float, pose: Pose | None
    ) -> tuple[_Frame, TrackState | None]:
        """Find the marker, go on with the clock."""
        timings: dict[str, StageTiming] = {}
        state: TrackState | None = None
        if self._tracker is not None and pose is None:
            if host_image is None:
                with exclusive(self.device):
                    host_image = image.numpy()
            start = time.perf_counter()
            track = self._tracker.track(cast(Image, host_image), now)
            timings[TRACK] = StageTiming((time.perf_counter() - start) * 1e3, False)
            pose, state = track.pose, track.state
        lost = self._tracker is not None and pose is None
        seconds, step = now - (self._start_time or 0.0), max(now - self._lit_time, 0.0)
        self._last_time = self._lit_time = now
        self._index += 1
        return _Frame(image, None, pose, lost, self._index - 1, now, seconds, step, timings), state

    def _render(self, frame: _Frame) -> Rendered:
        """Run the stages on a frame."""
        timings = frame.timings
        start = time.perf_counter()
        if not frame.lost:
            self._scheduler.prepare()
            with exclusive(self.device):
                if self._short is not None and self._short.refresh(frame.time):
                    self._has_light = False
                self._set_frame_values(frame)
                self._take_frame(frame)
                timings = {**timings, **self._scheduler.run()}
            self._has_light = True
        # A lost marker says nothing about where objects are: the frame passes as it came, the last light is kept.
        self._shown = frame.image if frame.lost or "image" not in self._arrays else self._arrays["image"]
        return Rendered(self._shown, self._light(), timings, (time.perf_counter() - start) * 1e3)

    def _light(self) -> Any:
        return self._arrays["environment"] if self._has_light and "environment" in self.plan.request.outputs else None

    def _take_short(
        self,
        image: Any,
        host_image: npt.NDArray[np.uint8] | None,
        exposure: int,
        now: float,
        pose: Pose | None,
    ) -> Result:
        """Let a frame of another exposure tell of the light; the picture stays."""
        self._finish()
        timings: dict[str, StageTiming] = {}
        state: TrackState | None = None
        bright: Any = image
        if self._shown is None or (self._tracker is not None and pose is None):
            picture = image.numpy() if host_image is None else host_image
            bright = brightened(picture, self._decode, self.plan.request.exposures[exposure])
        if self._tracker is not None and pose is None:
            start = time.perf_counter()
            track = self._tracker.track(bright, now)
            timings[TRACK] = StageTiming((time.perf_counter() - start) * 1e3, False)
            pose, state = track.pose, track.state
        if self._short is not None and pose is not None:
            start = time.perf_counter()
            with exclusive(self.device):
                self._short.take(image, exposure, pose, self._block.host("params"), now)
            timings["unwrap"] = StageTiming((time.perf_counter() - start) * 1e3, False)
        self._last_time = now
        shown = bright if self._shown is None else self._shown
        return Result(pose, state, _done(self._keep(Rendered(shown, self._light(), timings))), shown=False)

    def _accept(self, image: Any) -> npt.NDArray[np.uint8] | None:
        width, height = self.size
        if isinstance(image, wp.array):
            if image.shape != (height, width) or image.dtype != wp.vec3ub or image.device != self.device:
                raise UsageError(
                    f"frame is a Warp array {image.shape} of {image.dtype.__name__} on {image.device}; "
                    f"expected ({height}, {width}) of vec3ub on {self.device}"
                )
            return None
        if not isinstance(image, np.ndarray) or image.shape != (height, width, 3) or image.dtype != np.uint8:
            got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise UsageError(f"frame is {got}; expected uint8 RGB ({height}, {width}, 3)")
        return np.ascontiguousarray(image)

    def _set_frame_values(self, frame: _Frame) -> None:
        params, pose = self._params, frame.pose
        touched: list[str] = ["clock"]
        if self._host_scene.write_lights(self._block.host("lights"), frame.seconds) or frame.index == 0:
            touched.append("lights")
        if self._host_scene.write_objects(self._block.host("objects"), frame.seconds) or frame.index == 0:
            touched.append("objects")
        moved = False
        if pose is not None:
            position, rotation = params["camera_position"], params["world_from_camera"]
            before = position.tobytes(), rotation.tobytes()
            inverse = pose.inverse()
            position[0], rotation[0] = inverse.translation, inverse.rotation
            moved = before != (position.tobytes(), rotation.tobytes())
            outlines = self._outlines()
            rects = dict(zip(outlines, screen_rects(list(outlines.values()), pose, self.camera), strict=True))
            rects.setdefault("light", rects["direct"])
            self._rects.update(rects)
            for name, rect in rects.items():
                params[f"{name}_rect"][0] = rect
        if moved or self._arrays.version("pose") == 0:
            touched.append("pose")
        params["time"][0] = frame.seconds
        params["time_step"][0] = frame.step
        params["frame_index"][0] = frame.index
        params["environment_reset"][0] = not self._has_light
        self._block.upload()
        for name in touched:
            self._arrays.touch(name)

    def _outlines(self) -> dict[str, Outline]:
        """What of the screen a frame asks about; ``light`` only where it is more than what is lit directly."""
        scene, arrays = self._host_scene, self._arrays
        outlines = {"object": scene.object_outline(), "direct": scene.light_outline()}
        if "relight_bounced" in arrays:
            outlines["light"] = scene.light_outline(bounced=True)
        if "mirrored" in arrays:
            outlines["ball"] = scene.ball_outline()
        if "shadow_ratio" in arrays:
            outlines["shadow"] = scene.shadow_outline()
        return outlines

    def _rows(self, name: str) -> Rows:
        """Rows of one of ``RECTS`` in this frame."""
        return self._rects[name][:2]

    def _take_frame(self, frame: _Frame) -> None:
        """The frame becomes the one that stages read."""
        if frame.slot is not None and self._transfers is not None:
            self._transfers.receive(frame.slot, self._frame)
        elif isinstance(frame.image, wp.array):
            wp.copy(self._frame, frame.image)
        else:
            target = self._frame.numpy()
            if frame.index and np.array_equal(target, frame.image):
                return  # a still picture: nothing that reads the frame needs to run
            np.copyto(target, frame.image)
        self._arrays.touch("frame")


def _done(rendered: Rendered) -> Future[Rendered]:
    future: Future[Rendered] = Future()
    future.set_result(rendered)
    return future


def resample_light(
    radiance: npt.NDArray[np.float32],
    confidence: npt.NDArray[np.float32],
    clipped: npt.NDArray[np.float32],
    shape: tuple[int, int],
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """The remembered light at another size, (rows, columns): means weighted by confidence."""

    def resize(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        way = cv2.INTER_AREA if shape[0] < values.shape[0] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(values, (shape[1], shape[0]), interpolation=way), np.float32)

    known = resize(confidence)
    weight = np.where(known > 0.0, known, 1.0)[..., None]
    return resize(radiance * confidence[..., None]) / weight, known, resize(clipped * confidence[..., None]) / weight
