"""Pipeline: built from a scene, a device and a quality, and called with frames."""

from __future__ import annotations

import collections
import contextlib
import copy
import dataclasses
import difflib
import functools
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.closing import Closing
from warp_ar.declared import checked
from warp_ar.device import exclusive, resolve_device, translating
from warp_ar.engine.arguments import check_frames, check_methods, check_number
from warp_ar.engine.environment_history import CarriedLight
from warp_ar.engine.frame_exchange import Borrowed, adopt_frame
from warp_ar.engine.frame_inputs import FrameInputs, SeenFrame
from warp_ar.engine.graph import make_plan
from warp_ar.engine.layers import LayerArrays, layer_arrays, neutral_layers
from warp_ar.engine.modules import Progress
from warp_ar.engine.result import TRACK, Rendered, Result, done_at_once
from warp_ar.engine.scene_objects import Edit, SceneObjects
from warp_ar.engine.scheduler import Scheduler, StageTiming
from warp_ar.engine.short_frames import ShortFrames
from warp_ar.engine.transfer import Image
from warp_ar.errors import UpdateError, UsageError, WarpArError, check_process
from warp_ar.light.captured import has_places
from warp_ar.scene import Pose, Scene, load_scene
from warp_ar.scene.kinds import difference
from warp_ar.sources.deep_frame import DeepFrame, as_deep_frame, check_deep_frame, codes8
from warp_ar.sources.exposures import BracketPlan, brightened, find_exposure, plan_bracket
from warp_ar.stages.base import Arrays
from warp_ar.stages.captured import Captured
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS, Quality
from warp_ar.stages.request import Estimates, Request
from warp_ar.tracking.tracking import Places, Track, Tracker, TrackState, given_pose, own_markers, track_markers

__all__ = ["DEFAULT_FRAME_INTERVAL", "TRACK", "Pipeline", "Result", "resolve_quality"]

AHEAD = 2
"""Largest number of submitted frames that wait to be rendered."""

DEFAULT_FRAME_INTERVAL = 1.0 / 30.0
"""Seconds between frames for which the caller gives no time."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def resolve_quality(quality: str | Quality) -> Quality:
    """Return the ``Quality`` for a preset's name, or the given ``Quality``, checked.

    Raises:
        UsageError: No preset has that name, or a ``Quality`` names an unknown method.
    """
    if isinstance(quality, Quality):
        check_methods(quality)
        return quality
    if not isinstance(quality, str) or quality not in PRESETS:
        close = difflib.get_close_matches(str(quality), PRESETS, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise UsageError(f"quality {quality!r} is no preset; {hint}expected {', '.join(PRESETS)}")
    return PRESETS[quality]


def _has_places(scene: Scene) -> bool:
    """Return True if the scene's captured light has emitters with known distances."""
    return scene.captured is not None and has_places(scene.captured.file)


def cannot_run(quality: Quality, error: BaseException) -> UsageError:
    """Return the error for a pipeline that cannot be built, for example because the device's memory is full."""
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return UsageError(f"quality {quality.name!r} cannot run here: {reason}; choose a cheaper one")


def _in_turn(method: Callable[Concatenate[Pipeline, _P], _R]) -> Callable[Concatenate[Pipeline, _P], _R]:
    """Wrap a method so that only one thread at a time runs the methods of one pipeline."""

    @functools.wraps(method)
    def call(self: Pipeline, /, *arguments: _P.args, **named: _P.kwargs) -> _R:
        # In a forked process the lock may be held by a thread that does not exist there.
        with self._turn if os.getpid() == self._process else contextlib.nullcontext():
            return method(self, *arguments, **named)

    return call


class Pipeline(Closing):
    """Pipeline that lights the frames of one camera, one frame per call.

    The kernels' arrays are allocated by the constructor and by ``change``, never for a frame.
    """

    bracket: BracketPlan
    """Exposures that are merged, and the exposure that is shown."""

    @checked
    def __init__(
        self,
        scene: Scene | str | os.PathLike[str],
        *,
        device: str = "auto",
        quality: str | Quality = DEFAULT_PRESET,
        size: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("image",),
        exposures: Sequence[float] = (),
        shown: float | None = None,
        bands: int | None = None,
        profile: bool = False,
        estimates: Estimates = "delayed",
        emitters: bool = False,
        follows_camera: bool | None = None,
        culling: bool = True,
        linear: bool = False,
    ) -> None:
        """Plan the stages, allocate their arrays and build their passes.

        Args:
            scene: A scene, a scene file, or a bundled scene's name.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name or a ``Quality``.
            size: Width and height of the frames in pixels; None means the scene's. Another size must scale its camera
                exactly.
            outputs: Parts of the results: ``image``, ``environment``, ``pose``, ``radiance`` (the picture before it is
                encoded in 8 bits), and layers by the names of ``warp_ar.LAYERS``, such as ``depth``. Stages that no
                output needs do not run.
            exposures: Exposure times in seconds between which the frames alternate. Frames of one exposure are lit and
                shown; the others measure light that is clipped or too dark in it.
            shown: Exposure time in seconds of the frames that are shown; None means the longest.
            bands: Bands of rows per CPU pass; None means one or two per core.
            profile: On CUDA, wait for every frame and time each stage on the device.
            estimates: Frame in which light estimated from a frame takes effect. ``synchronous``: the same frame, which
                waits for the estimate. ``delayed``: a fixed time later, the same in every run. ``real_time``, for live
                cameras: as soon as a separate process has computed it; no frame waits, and pictures of two runs may
                differ for some frames.
            emitters: True if positions of emitters will be passed to ``take_light``.
            follows_camera: True to estimate drifts of the camera's exposure and white balance, and its tone curve,
                from successive frames; None: if the scene declares an automatic exposure. Light that dims equally on
                all surfaces is then taken for a drift.
            culling: True to leave out, in each frame, the stages that can change none of its pixels; pictures do not
                depend on it.
            linear: True if frames have more than 8 bits: uint16 codes, or linear radiance as floats. Mirror balls,
                surfaces and the layer ``plate`` use the full bit depth; markers are found in 8 bits.

        Raises:
            UsageError: An argument cannot be used.
            SceneError: The scene cannot be used, has a number that is not finite, or has a camera that does not fit
                ``size``.
        """
        scene = scene if isinstance(scene, Scene) else load_scene(scene)
        outputs = check_frames(exposures, outputs)
        if shown is not None:
            check_number("shown", shown, above=0.0)
        for name, numbers in (("size", size), ("bands", bands)):
            if numbers is not None and np.min(numbers) < 1:
                raise UsageError(f"{name} = {numbers!r}: expected whole numbers above 0")
        self._closed, self._process = False, os.getpid()
        self._turn = threading.RLock()
        self.device, self.quality = resolve_device(device), resolve_quality(quality)
        self.camera = scene.camera if size is None else scene.camera.scaled_to(*size)
        self.scene = dataclasses.replace(scene, camera=self.camera)
        self.size = (self.camera.width, self.camera.height)
        self.bracket = plan_bracket(exposures, shown)
        emitters |= _has_places(self.scene)
        form = outputs, self.bracket.ratios, estimates, emitters, linear
        self.plan = make_plan(Request(self.scene, self.quality, self.size, *form))
        self._follows_camera = follows_camera
        self._running: dict[str, Any] = {"bands": bands, "profile": profile, "culling": culling}
        self._start_over()
        self._build(Arrays(), {})

    def _follows_gain(self) -> bool:
        """Return True if drifts of the camera's gain (exposure and white balance) are estimated from frames."""
        follows = self._follows_camera
        if follows is None:
            follows = self.scene.source is not None and self.scene.source.metering == "automatic"
        # With several exposures, the gain follows from the frames' exposure times. The paper's method, which keeps
        # clipped light, has no estimate of the gain.
        return follows and self.quality.method("recover") != "clipped" and not self.plan.request.exposures

    def _start_over(self) -> None:
        """Reset the state to that before the first frame."""
        self._begun = 0
        self._start_time: float | None = None
        self._last_time = 0.0
        self._lit_time = 0.0
        self._shown: Any = None
        self._renderer: ThreadPoolExecutor | None = None
        self._ahead: collections.deque[Future[Rendered]] = collections.deque()

    def _build(self, arrays: Arrays, spare: Mapping[str, Any]) -> None:
        """Allocate the plan's arrays and build the passes of its stages.

        Args:
            arrays: Collection to which the new arrays are added.
            spare: Former arrays, by name, that may be reused and overwritten.
        """
        with translating(self.device), wp.ScopedDevice(self.device):
            self._allocate(arrays, spare)

    def _allocate(self, arrays: Arrays, spare: Mapping[str, Any]) -> None:
        tracked = self.plan.needs("pose") and self.scene.pose is None
        self._tracker = Tracker(self.scene.marker, self.camera) if tracked else None
        self._own_markers = {marker: Tracker(marker, self.camera) for marker in own_markers(self.scene)}
        self._index = 0  # index of the next frame of these arrays
        self._borrowed = Borrowed(self.device)
        self._arrays = arrays
        self._light = CarriedLight(self._arrays, wanted="environment" in self.plan.request.outputs)
        deep = self.plan.needs("linear_frame")
        self.inputs = FrameInputs(
            self.scene,
            self.camera,
            self._arrays,
            self.device,
            follows_gain=self._follows_gain(),
            watches_ball=self.plan.features.recovered and not self.plan.request.exposures,
            linear=deep,
        )
        self._scheduler = Scheduler(self.plan, self._arrays, self.device, spare=spare, **self._running)
        self._scheduler.launch_first(self.inputs.first_launches)
        request = self.plan.request
        waits = self._running["profile"] or request.asks_for_layers or request.estimates == "synchronous"
        self._launches_here = self.inputs.transfers is not None and "image" in self._arrays and not waits
        """True if the caller's thread launches the kernels of submitted frames, without waiting for the device."""
        short = self.plan.needs("short_frames")
        self._short = ShortFrames(self.plan.features, self._arrays, self.device) if short else None

    @_in_turn
    def close(self) -> None:
        """Stop the worker threads. The arrays are freed once no ``Result`` refers to them."""
        if self._closed or os.getpid() != self._process:
            return  # a forked process has neither the threads nor the device
        self._closed = True
        if self._renderer is not None:
            self._renderer.shutdown()
        self.inputs.close()
        self._scheduler.close()

    def _check_usable(self) -> None:
        if self._closed:
            raise UsageError("the pipeline is closed; make another one")
        check_process("the pipeline was made", self._process)

    @property
    def scheduler(self) -> Scheduler:
        """Scheduler that runs and times the stages."""
        return self._scheduler

    @property
    def arrays(self) -> Arrays:
        """All arrays of the pipeline by name, on its device."""
        return self._arrays

    @_in_turn
    def update(self, scene: Scene) -> None:
        """Use another scene that differs in numbers only, from the next frame on; nothing is allocated or compiled.

        Positions, sizes, colours, intensities, values of materials and the exposure's scale are numbers. Changes that
        add or remove a stage, an array or a kernel need ``change``.

        Args:
            scene: The new scene; its camera is scaled to the size of the frames.

        Raises:
            UpdateError: Something other than numbers differs; the message names it, and nothing has changed.
            SceneError: The scene's camera does not fit the size of the frames, or a number is not finite.
            UsageError: The pipeline is closed, or belongs to another process.
        """
        scene = self._check_next(scene)
        if name := "camera" if self.camera != scene.camera else difference(self.scene, scene):
            raise UpdateError(f"update: {name} differs, and arrays or kernels are made for it; call change instead")
        plan = make_plan(dataclasses.replace(self.plan.request, scene=scene))
        if plan.stages != self.plan.stages:
            stages = {kind.name for kind, _ in {*plan.stages} ^ {*self.plan.stages}}
            raise UpdateError(f"update: the scene calls for other work of {', '.join(sorted(stages))}; call change")
        before = self.scene
        placed = scene.objects != before.objects or scene.lights != before.lights
        self.inputs.update(scene, placed=placed, exposed=scene.exposure != before.exposure)
        self.scene, self.plan = scene, plan

    @checked
    def _check_next(self, scene: Scene) -> Scene:
        """Check that the pipeline is usable, wait for submitted frames, and fit the scene's camera to the frame size.

        Raises:
            UsageError: The pipeline is closed or belongs to another process.
            SceneError: The scene's camera does not fit the size of the frames.
        """
        self._check_usable()
        self._finish()
        return dataclasses.replace(scene, camera=scene.camera.scaled_to(*self.size))

    @_in_turn
    def change(self, scene: Scene | None = None, *, quality: str | Quality | None = None) -> None:
        """Change scene or quality from the next frame on; light, clock and the marker's track continue.

        Changes that ``update`` can make are made by it. For others, arrays are allocated anew, and kernels that are not
        in this machine's cache are compiled by the next frame or by ``warm_up``. ``PipelineSwitcher`` does both
        concurrently with the frames.

        Args:
            scene: The next scene; None keeps the current one.
            quality: A preset's name or a ``Quality``; None keeps the current one.

        Raises:
            UsageError: ``scene`` is not a Scene, or the quality is unknown or cannot run here; nothing has changed.
            SceneError: The scene's camera does not fit the frames, or a file that it names cannot be used.
        """
        scene = self._check_next(self.scene if scene is None else scene)
        quality = self.quality if quality is None else resolve_quality(quality)
        if quality == self.quality:
            with contextlib.suppress(UpdateError):
                return self.update(scene)
        emitters = self.plan.request.emitters or _has_places(scene)
        plan = make_plan(dataclasses.replace(self.plan.request, scene=scene, quality=quality, emitters=emitters))
        before = copy.copy(self)
        self.scene, self.camera, self.quality, self.plan = scene, scene.camera, quality, plan
        try:
            # Former arrays are reused, because memory that is new to the process takes long to fill.
            self._build(Arrays(self._scheduler.constants()), self._scheduler.spare())
        except BaseException as error:
            vars(self).update(vars(before))
            self._scheduler.forget()  # the former arrays may have been overwritten
            if isinstance(error, RuntimeError | MemoryError) and not isinstance(error, WarpArError):
                raise cannot_run(quality, error) from error
            raise
        self._go_on(before)
        before.inputs.close()
        before._scheduler.close()
        before._scheduler.let_go()

    def warm_up(self, progress: Progress | None = None) -> None:
        """Load every kernel, so that the first frame takes no longer than others; other pipelines may run meanwhile.

        Args:
            progress: Receives the numbers of compiled modules and of all modules to compile, first 0, on the caller's
                thread; not called if all are in the cache.
        """
        self._check_usable()
        self._scheduler.warm_up(progress)

    @_in_turn
    def continue_from(self, other: Pipeline) -> None:
        """Continue from another pipeline: take over its clock and, where they fit, the marker's track and the light."""
        self._check_usable()
        self._finish()
        other._finish()
        self._start_time, self._last_time, self._lit_time = other._start_time, other._last_time, other._lit_time
        self._shown = other._shown
        self._go_on(other)

    @property
    def objects(self) -> SceneObjects:
        """Virtual objects by name or index: ``pipeline.objects["lamp"].world_from_object = matrix``."""
        return SceneObjects(lambda: self.scene.objects, self._edit_objects)

    @_in_turn
    def _edit_objects(self, edit: Edit) -> None:
        self.change(dataclasses.replace(self.scene, objects=tuple(edit(self.scene.objects))))

    def _go_on(self, other: Pipeline) -> None:
        """Take over another pipeline's track of the marker, if it fits, and the estimates that it made from frames."""
        if (self.scene.marker, self.camera) == (other.scene.marker, other.camera) and other._tracker and self._tracker:
            self._tracker = other._tracker
        if self.camera == other.camera and own_markers(self.scene) == own_markers(other.scene):
            self._own_markers = other._own_markers
        with exclusive(self.device):
            self._light.take_over(other._light)
            self.inputs.continue_from(other.inputs)
            self._scheduler.continue_from(other._scheduler)
        if self._short is not None and other._short is not None:
            self._short.resume(other._short)

    @_in_turn
    def restart(self, *, saturation: npt.NDArray[np.float64] | None = None) -> None:
        """Treat the next frame as the first of a clip that starts at 0 seconds, independent of all earlier frames.

        The pictures of a part of a clip are then those that the whole clip gives. This needs a given light: an
        environment accumulated over frames depends on earlier frames. If the part does not start with the clip's first
        frame, the poses must be given as well.

        Args:
            saturation: 8-bit codes at which the camera's channels saturate, (3,), for all later frames; None: unknown.

        Raises:
            UsageError: The scene's light comes from a mirror ball in the frames.
        """
        self._check_usable()
        self._finish()
        if self.plan.features.observed:
            raise UsageError("restart needs a captured light: a mirror ball's is gathered over the frames before")
        self._begun, self._start_time, self._last_time = 0, 0.0, 0.0
        self._lit_time = math.inf  # no previous frame
        self._shown = None
        if self._tracker is not None:
            self._tracker.reset()
        self.inputs.forget_drift()
        if saturation is not None:
            self.inputs.fix_saturation(saturation)
        self._scheduler.restart()

    @_in_turn
    def start_clock(self, seconds: float) -> None:
        """Start animations at a time before the first frame; without this call they start with it.

        Args:
            seconds: Start time on the clock of ``time_seconds``.

        Raises:
            UsageError: A frame has been lit already, the pipeline is closed, or the time is not finite.
        """
        self._check_usable()
        check_number("seconds", seconds)
        if self._begun:
            raise UsageError("start_clock comes before the first frame")
        self._start_time = self._last_time = seconds
        self._lit_time = math.inf  # no previous frame

    @_in_turn
    def take_light(self, radiance: npt.NDArray[np.float32], emitters: npt.NDArray[Any] | None = None) -> None:
        """Light the next frames with another environment in place of the captured light that the scene names.

        Args:
            radiance: Linear RGB in the scene's axes, float32 (height, 2 height, 3), with the quality's
                ``environment_height``; it is referenced, not copied.
            emitters: Emitters with positions, from ``Result.emitters``; they are copied.

        Raises:
            UsageError: The scene names no captured light, or the map has another size.
        """
        self._check_usable()
        self._finish()
        stage = self._scheduler.stage("captured")
        if not isinstance(stage, Captured):
            raise UsageError("take_light needs a scene with a captured light that some stage reads")
        stage.replace(radiance, emitters)
        self._arrays.touch("captured_light")

    @_in_turn
    def __call__(
        self,
        image: npt.NDArray[np.uint8] | Any,
        *,
        time_seconds: float | None = None,
        pose: Pose | Track | None = None,
        exposure_time: float | None = None,
    ) -> Result:
        """Light one frame.

        Args:
            image: uint8 RGB (height, width, 3) of NumPy or of an object with ``__dlpack__`` or
                ``__cuda_array_interface__`` (torch, JAX, CuPy), or a Warp array (height, width) of ``wp.vec3ub``. It
                lies on the host or on the pipeline's device. On the device it is copied to the host only if the marker
                must be found, and must not change until it has been rendered. A pipeline with ``linear`` also takes
                uint16 codes, linear floats and a `DeepFrame`.
            time_seconds: Time at which the frame was taken; without times, frames come 30 times a second.
            pose: Known pose ``camera_from_world``, or the result of the caller's tracker; the marker is then not
                searched for.
            exposure_time: Exposure time in seconds; None means the exposure of the frames that are shown.

        Raises:
            UsageError: The image has another size or type, a number is not finite, or the pipeline is closed or belongs
                to another process.
        """
        return self._begin(image, time_seconds, pose, exposure_time, ahead=False)

    def new_frame(self) -> Image:
        """Return an array into which a source can write a frame for ``submit``.

        On CUDA its memory is pinned, and the frame is sent from it; other frames are first copied to pinned memory. A
        submitted frame must not be changed; request a new array for the next frame. Memory is reused when nothing
        refers to it any more. Beyond 512 MB of pinned memory, arrays have ordinary memory.

        Returns:
            uint8 (height, width, 3), of any values. It stays valid after the pipeline has been closed.
        """
        if self.inputs.transfers is not None:
            return self.inputs.transfers.new_frame()
        return np.empty((self.size[1], self.size[0], 3), np.uint8)

    @_in_turn
    def submit(
        self,
        image: npt.NDArray[np.uint8] | Any,
        *,
        time_seconds: float | None = None,
        pose: Pose | Track | None = None,
        exposure_time: float | None = None,
    ) -> Result:
        """Light one frame without waiting for the result; the arguments are those of ``__call__``.

        This thread finds the marker. On CUDA it also starts the frame's transfer, the kernels and the picture's
        transfer back. On CPU another thread renders the frame. If the next frame is submitted before this result's
        image is read, tracking, both transfers and the kernels overlap. Device arrays of a result are valid until the
        next frame is rendered. On CPU an image that is not writable (``flags.writeable``) is assumed not to change and
        is not copied. On CUDA an image from ``new_frame`` is not copied.
        """
        return self._begin(image, time_seconds, pose, exposure_time, ahead=True)

    def _begin(
        self,
        image: Any,
        time_seconds: float | None,
        given: Pose | Track | None,
        exposure_time: float | None,
        *,
        ahead: bool,
    ) -> Result:
        """Check a frame, find its pose and render it.

        Args:
            image: Frame in a form that ``__call__`` takes.
            time_seconds: Time of the frame, or None.
            given: Known pose or track, or None.
            exposure_time: Exposure time in seconds, or None.
            ahead: True to return without waiting for the result.
        """
        self._check_usable()
        if time_seconds is not None:
            check_number("time_seconds", time_seconds)
        if exposure_time is not None:
            check_number("exposure_time", exposure_time, above=0.0)
        pose = given.pose if isinstance(given, Track) else given
        if pose is not None and not isinstance(pose, Pose):
            raise UsageError(f"pose is {type(pose).__name__}; expected a Pose(R, t), camera_from_world, or a Track")
        deep, image = self._take_depth(image)
        picture = adopt_frame(image, self.size, self.device)
        result = self._light_frame(picture, time_seconds, given, exposure_time, ahead=ahead, deep=deep)
        if picture is not image and isinstance(picture, wp.array):
            self._borrowed.keep(picture)
        return result

    def _take_depth(self, image: Any) -> tuple[DeepFrame | None, Any]:
        """Return the frame at its full bit depth (None for an 8-bit frame), and as 8-bit pixel values."""
        if not self.plan.request.linear:
            if isinstance(image, np.ndarray) and image.dtype != np.uint8 and image.dtype.kind in "uf":
                width, height = self.size
                right = f"uint8 RGB ({height}, {width}, 3), or a pipeline made with linear=True"
                raise UsageError(f"frame is {image.dtype} {image.shape}; expected {right}")
            return None, image
        transfer = str(self.camera.transfer)
        if isinstance(image, np.ndarray) and image.dtype == np.uint8:
            return DeepFrame(image.astype(np.uint16) * np.uint16(257)), image
        deep = image if isinstance(image, DeepFrame) else as_deep_frame(np.asarray(image), self.size)
        check_deep_frame(deep.picture, self.size)
        return deep, codes8(deep, transfer) if deep.codes is None else deep.codes

    def _light_frame(
        self,
        image: Any,
        time_seconds: float | None,
        pose: Pose | Track | None,
        exposure_time: float | None,
        *,
        ahead: bool,
        deep: DeepFrame | None = None,
    ) -> Result:
        """Find the pose of a frame with checked arguments, and render it or, if ``ahead``, begin to."""
        host_image = image if isinstance(image, np.ndarray) else None
        if pose is None:
            pose = given_pose(self.scene.pose, self._begun)
        self._begun += 1
        handed_over = ahead and host_image is not None
        now = self._last_time + DEFAULT_FRAME_INTERVAL if time_seconds is None else time_seconds
        if self._start_time is None:
            self._start_time = self._last_time = self._lit_time = now
        exposure = find_exposure(exposure_time, self.bracket)
        if not handed_over or exposure != self.bracket.reference:
            self._finish()
        if exposure != self.bracket.reference:
            return self._take_short(image, host_image, exposure, now, pose, deep)
        frame, state = self._look(image if host_image is None else host_image, now, pose, deep)
        if handed_over:
            return Result(frame.pose, state, self._hand_over(frame))
        rendered = self._render(self._send(frame))
        return Result(frame.pose, state, (self._keep(rendered) if ahead else rendered).at_once())

    def _send(self, frame: SeenFrame) -> SeenFrame:
        """Start the transfer of a frame to the device, unless the image is there already; return the updated frame."""
        if self.inputs.transfers is None or frame.lost or isinstance(frame.image, wp.array):
            return frame
        frame.slot = self.inputs.transfers.upload(frame.image)
        return frame

    def _hand_over(self, frame: SeenFrame) -> Future[Rendered]:
        """Render a host frame asynchronously: this thread launches it on CUDA, another one runs it on CPU."""
        while len(self._ahead) >= AHEAD:
            self._ahead.popleft().result()
        frame = self._send(frame)
        if frame.lost or not self._launches_here:
            # The caller may overwrite a writable image before it is rendered.
            if frame.slot is not None and "image" in self._arrays:
                frame.image = frame.slot.host  # the slot is not reused before this frame is rendered: see ``AHEAD``
            elif frame.image.flags.writeable:
                frame.image = frame.image.copy()

        def render() -> Rendered:
            return self._keep(self._render(frame))

        if self._launches_here:
            self._ahead.append(done_at_once(render))
        else:
            if self._renderer is None:
                self._renderer = ThreadPoolExecutor(1, "warp_ar-render")
            self._ahead.append(self._renderer.submit(render))
        return self._ahead[-1]

    def _finish(self) -> None:
        """Wait until all submitted frames are rendered."""
        while self._ahead:
            self._ahead.popleft().result()

    def _keep(self, rendered: Rendered) -> Rendered:
        """Copy the outputs of a frame to the host, or start their transfer, before the next frame overwrites them."""
        lit, transfers = rendered.image_array, self.inputs.transfers
        if rendered.layers is not None:
            rendered = dataclasses.replace(rendered, layers=rendered.layers.to_host())
        if transfers is None or "image" not in self._arrays:
            rendered = rendered.with_light_kept()
        if isinstance(lit, wp.array):
            lit = np.array(lit.numpy()) if transfers is None else transfers.download(lit)
        return dataclasses.replace(rendered, image=lit)

    def _track(
        self, image: Any, now: float, pose: Pose | Track | None, timings: dict[str, StageTiming]
    ) -> tuple[Pose | None, TrackState | None]:
        """Find the marker, unless the pose is known or not needed; return pose and state, and note the time."""
        if isinstance(pose, Track):
            return pose.pose, pose.state
        if self._tracker is None or pose is not None:
            return pose, None
        self._scheduler.prepare()
        if isinstance(image, wp.array):
            with exclusive(self.device):
                image = image.numpy()
        start = time.perf_counter()
        track = self._tracker.track(cast(Image, image), now)
        timings[TRACK] = StageTiming((time.perf_counter() - start) * 1e3, False)
        return track.pose, track.state

    def _find_own_markers(self, image: Any, now: float, pose: Pose | None, timings: dict[str, StageTiming]) -> Places:
        """Return the poses of the markers to which objects, lights or other parts of the scene are attached."""
        if not self._own_markers:
            return {}
        if isinstance(image, wp.array):
            with exclusive(self.device):
                image = image.numpy()
        start = time.perf_counter()
        places = track_markers(self._own_markers, cast(Image, image), now, pose)
        before = timings[TRACK].milliseconds if TRACK in timings else 0.0
        timings[TRACK] = StageTiming(before + (time.perf_counter() - start) * 1e3, False)
        return places

    def _look(
        self, image: Any, now: float, given: Pose | Track | None, deep: DeepFrame | None
    ) -> tuple[SeenFrame, TrackState | None]:
        """Find the pose of a frame and advance the clock; return the frame and the state of the track."""
        timings: dict[str, StageTiming] = {}
        pose, state = self._track(image, now, given, timings)
        lost = pose is None and (self._tracker is not None or isinstance(given, Track))
        places = self._find_own_markers(image, now, pose, timings)
        seconds, step = now - (self._start_time or 0.0), max(now - self._lit_time, 0.0)
        self._last_time = self._lit_time = now
        self._index += 1
        return SeenFrame(image, None, pose, lost, self._index - 1, now, seconds, step, timings, places, deep), state

    def _render(self, frame: SeenFrame) -> Rendered:
        """Run the stages on a frame; a frame whose marker is lost becomes the picture without virtual content."""
        timings: Mapping[str, StageTiming] = frame.timings
        start = time.perf_counter()
        if not frame.lost:
            self._scheduler.prepare()
            with exclusive(self.device):
                if self._short is not None and self._short.refresh(frame.time):
                    self._light.known = False
                ratio, is_bent = self.inputs.look(frame)
                self._light.known &= not is_bent
                if ratio is not None:
                    self._light.scale(ratio)
                self.inputs.write(frame, reset=not self._light.known)
                timings = {**timings, **self._scheduler.run(self.inputs.receive)}
            self._light.known = True
        # Without a marker the objects' places are unknown: the picture is the frame, and the light is kept.
        self._shown = frame.image if frame.lost or "image" not in self._arrays else self._arrays["image"]
        layers = self._layers_of(frame.image if frame.lost else None)
        if layers is not None and frame.deep is not None:
            clip = frame.deep.clip_levels(str(self.camera.transfer), self.inputs.saturation.levels)[0]
            layers = layers.with_plate(self.inputs.radiance(frame.deep), clip)
        milliseconds = (time.perf_counter() - start) * 1e3
        light = self._light
        emitters = self._arrays.get("emitters") if light.environment is not None else None
        return Rendered(
            self._shown,
            light.environment,
            timings,
            milliseconds,
            layers,
            others_array=light.others,
            emitters_array=emitters,
        )

    def _layers_of(self, unlit: Any = None) -> LayerArrays | None:
        """Return the requested layers, or None; for a frame ``unlit``, which gets no virtual content, neutral ones."""
        request = self.plan.request
        if not request.asks_for_layers:
            return None
        if unlit is not None:
            return neutral_layers(request, unlit, self.inputs.decode)
        return layer_arrays(request, self._arrays)

    def _take_short(
        self,
        image: Any,
        host_image: Image | None,
        exposure: int | None,
        now: float,
        given: Pose | Track | None,
        deep: DeepFrame | None,
    ) -> Result:
        """Measure light from a frame of another exposure than the shown one; the result has the last shown picture.

        The light is measured only if the plan has the stage ``bracket``, which merges exposures.

        Args:
            image: The frame, on host or device.
            host_image: The frame if it is on the host, else None.
            exposure: Index of its exposure in the bracket; None if it was left out.
            now: Time of the frame, seconds.
            given: Known pose or track, or None.
            deep: The frame at full bit depth, or None.
        """
        timings: dict[str, StageTiming] = {}
        bright: Any = image
        if self._shown is None or (self._tracker is not None and given is None):
            picture = image.numpy() if host_image is None else host_image
            ratio = 1.0 if exposure is None else self.bracket.ratios[exposure]
            bright = brightened(picture, self.inputs.decode, ratio)
        pose, state = self._track(bright, now, given, timings)
        if self._short is not None and pose is not None and exposure is not None:
            start = time.perf_counter()
            with exclusive(self.device):
                params, linear = self.inputs.block.host("params"), None if deep is None else self.inputs.linear(deep)
                self._short.take(image, exposure, pose, params, now, linear)
            timings["unwrap"] = StageTiming((time.perf_counter() - start) * 1e3, False)
        self._last_time = now
        shown = bright if self._shown is None else self._shown
        layers = self._layers_of(bright if self._shown is None else None)
        light = self._light
        rendered = self._keep(Rendered(shown, light.environment, timings, layers=layers, others_array=light.others))
        return Result(pose, state, rendered.at_once(), shown=False)
