"""The library's face: a scene, a device and a quality make a pipeline; call it with frames."""

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
from warp_ar.engine.arguments import check_frames, check_methods, check_number, check_scene, read_scene
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
from warp_ar.errors import UpdateError, UsageError, WarpArError
from warp_ar.light.captured import has_places
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import difference
from warp_ar.sources.deep_frame import Plate, as_plate, check_plate, codes8
from warp_ar.sources.exposures import BracketPlan, brightened, find_exposure, plan_bracket
from warp_ar.stages.base import Arrays
from warp_ar.stages.captured import Captured
from warp_ar.stages.quality import DEFAULT_PRESET, PRESETS, Quality
from warp_ar.stages.request import Estimates, Request
from warp_ar.tracking.tracking import OwnMarkers, Places, Track, Tracker, TrackState, given_pose, own_markers

__all__ = ["DEFAULT_FRAME_INTERVAL", "TRACK", "Pipeline", "Result", "resolve_quality"]

AHEAD = 2
"""Submitted frames that may wait for being rendered."""

DEFAULT_FRAME_INTERVAL = 1.0 / 30.0
"""Seconds between frames whose caller gives no time."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def resolve_quality(quality: str | Quality) -> Quality:
    """Quality value for a preset's name.

    Raises:
        UsageError: No preset has that name, or a value of one's own names a method that is none.
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
    """Return whether a scene's captured light says where its emitters are."""
    return scene.captured is not None and has_places(scene.captured.file)


def cannot_run(quality: Quality, error: BaseException) -> UsageError:
    """Return the error to raise where a pipeline cannot be built, such as on a device whose memory is full."""
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return UsageError(f"quality {quality.name!r} cannot run here: {reason}; choose a cheaper one")


def _in_turn(method: Callable[Concatenate[Pipeline, _P], _R]) -> Callable[Concatenate[Pipeline, _P], _R]:
    """Have threads that call methods of one pipeline take turns."""

    @functools.wraps(method)
    def call(self: Pipeline, /, *arguments: _P.args, **named: _P.kwargs) -> _R:
        with self._turn:
            return method(self, *arguments, **named)

    return call


class Pipeline(Closing):
    """Lights frames: call it with one frame after another of one camera.

    Arrays are allocated here, never while frames run.
    """

    bracket: BracketPlan
    """Exposures that are merged, and the one that is shown."""

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
        """Plan, allocate and build.

        Args:
            scene: What to show: a scene, a scene file, or a bundled scene's name.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name or a value of one's own.
            size: Width and height of the frames; None means the scene's. Another must scale the scene's camera exactly.
            outputs: What results shall hold: ``image``, ``environment``, ``pose``, ``radiance`` (the picture before it
                is encoded in 8 bits), and layers by the names of ``warp_ar.LAYERS``, such as ``depth``; what none of
                them needs does not run.
            exposures: Exposure times in seconds between which the frames alternate. Frames of one are lit and shown;
                the others tell what clips in it, and what is too dark.
            shown: Which: seconds; None means the longest.
            bands: Bands of rows per CPU pass; None means one per core.
            profile: On CUDA wait for every frame and time each stage on the device.
            estimates: When light that is estimated from a frame takes effect: ``synchronous``: in that frame, which
                waits for it; ``delayed``: a fixed time later, the same in every run; ``real_time``, for live cameras:
                as soon as a process beside the frames has it. No frame waits then, and pictures of two runs may differ
                for some frames.
            emitters: Whether ``take_light`` will say where the emitters of the scene's captured light are.
            follows_camera: Whether a drift of the camera's exposure and white balance, and its tone curve, are told
                from frames one after another; None: if the scene says that the camera meters by itself. Light that
                dims on all surfaces alike is then taken for a drift.
            culling: Whether stages that can change no pixel of a frame are left out of it; pictures are the same.
            linear: Whether frames have more than 8 bits: uint16 codes, or linear radiance as floats. Mirror balls and
                surfaces are read, and the plate among the layers kept, at that depth; markers are found in 8 bits.

        Raises:
            UsageError: An argument that cannot be used.
            SceneError: The scene cannot be used, one of its numbers is not finite, or its camera does not fit ``size``.
        """
        scene = read_scene(scene)
        outputs = check_frames(exposures, outputs, linear)
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
        """Return whether a drift of the camera's gain is followed."""
        follows = self._follows_camera
        if follows is None:
            follows = self.scene.source is not None and self.scene.source.metering == "automatic"
        # Frames of several exposures tell their gain themselves; the paper takes all as the camera saw it.
        return follows and self.quality.method("recover") != "clipped" and not self.plan.request.exposures

    def _start_over(self) -> None:
        """Begin without a frame."""
        self._begun = 0
        self._start_time: float | None = None
        self._last_time = 0.0
        self._lit_time = 0.0
        self._shown: Any = None
        self._renderer: ThreadPoolExecutor | None = None
        self._ahead: collections.deque[Future[Rendered]] = collections.deque()

    def _build(self, arrays: Arrays, spare: Mapping[str, Any]) -> None:
        """Allocate what the plan calls for, and wire its stages.

        Args:
            arrays: Takes what is allocated.
            spare: Arrays of before that may be written anew.
        """
        with translating(self.device), wp.ScopedDevice(self.device):
            self._allocate(arrays, spare)

    def _allocate(self, arrays: Arrays, spare: Mapping[str, Any]) -> None:
        tracked = self.plan.needs("pose") and self.scene.pose is None
        self._tracker = Tracker(self.scene.marker, self.camera) if tracked else None
        self._own_markers = OwnMarkers(self.scene, self.camera)
        self._index = 0  # of frames that these arrays have seen
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
        """True if the caller's thread launches submitted frames: that waits for nothing on the device."""
        short = self.plan.needs("short_frames")
        self._short = ShortFrames(self.plan.features, self._arrays, self.device) if short else None

    @_in_turn
    def close(self) -> None:
        """Stop the worker threads; arrays go when the last result that refers to them does."""
        if self._closed or os.getpid() != self._process:
            return  # a fork has neither the threads nor the device
        self._closed = True
        if self._renderer is not None:
            self._renderer.shutdown()
        self.inputs.close()
        self._scheduler.close()

    def _check_usable(self) -> None:
        if self._closed:
            raise UsageError("the pipeline is closed; make another one")
        if os.getpid() != self._process:
            raise UsageError(
                f"the pipeline was made in process {self._process}, of which this one is a fork without its "
                "threads and its device; start processes by spawn"
            )

    @property
    def scheduler(self) -> Scheduler:
        """Scheduler that runs the stages and times them."""
        return self._scheduler

    @property
    def arrays(self) -> Arrays:
        """Every named array of the pipeline, on its device."""
        return self._arrays

    @_in_turn
    def update(self, scene: Scene) -> None:
        """Show another scene from the next frame on, if it differs in numbers alone; nothing is allocated or compiled.

        Positions, sizes, colours, intensities, the values of materials and the scale of the exposure are numbers. For
        what adds or drops a stage, an array or a kernel there is ``change``.

        Args:
            scene: The new scene; its camera is scaled as it was in the constructor.

        Raises:
            UpdateError: More than numbers differs; the message names it, and nothing has changed.
            SceneError: The scene's camera does not fit the size of the frames, or a number is not finite.
            UsageError: The pipeline is closed, or another process's.
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

    def _check_next(self, scene: Scene) -> Scene:
        """Return a scene that is to be shown next, at the size of the frames, with all that was submitted rendered."""
        self._check_usable()
        check_scene(scene)
        self._finish()
        return dataclasses.replace(scene, camera=scene.camera.scaled_to(*self.size))

    @_in_turn
    def change(self, scene: Scene | None = None, *, quality: str | Quality | None = None) -> None:
        """Show another scene, at another quality, from the next frame on; light, clock and track of the marker go on.

        What ``update`` can do is done so. For all else arrays are made anew, and kernels of kinds that no pipeline of
        this machine has had are compiled by the next frame, or by ``warm_up``; ``PipelineSwitcher`` does both beside
        the frames.

        Args:
            scene: The next scene; None leaves it.
            quality: A preset's name or a value; None leaves it.

        Raises:
            UsageError: ``scene`` is no scene, or the quality is none or cannot run here. What is refused changes
                nothing.
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
            # Memory that is new to the process takes long to fill.
            self._build(Arrays(self._scheduler.constants()), self._scheduler.spare())
        except BaseException as error:
            vars(self).update(vars(before))
            self._scheduler.forget()  # what was spare may have been written
            if isinstance(error, RuntimeError | MemoryError) and not isinstance(error, WarpArError):
                raise cannot_run(quality, error) from error
            raise
        self._go_on(before)
        before.inputs.close()
        before._scheduler.close()
        before._scheduler.let_go()

    def warm_up(self, progress: Progress | None = None) -> None:
        """Load every kernel, so that the first frame takes no longer than others; may run beside another pipeline.

        Args:
            progress: Called with how many of how many modules are compiled, first with 0, if any must be: kernels are
                compiled once for a kind of scene and kept. On the caller's thread.
        """
        self._check_usable()
        self._scheduler.warm_up(progress)

    @_in_turn
    def continue_from(self, other: Pipeline) -> None:
        """Go on where another pipeline stopped: its clock and, where they fit, its track and its light."""
        self._check_usable()
        self._finish()
        other._finish()
        self._start_time, self._last_time, self._lit_time = other._start_time, other._last_time, other._lit_time
        self._shown = other._shown
        self._go_on(other)

    @property
    def objects(self) -> SceneObjects:
        """Virtual objects by name or number: ``pipeline.objects["lamp"].world_from_object = matrix``."""
        return SceneObjects(lambda: self.scene.objects, self._edit_objects)

    @_in_turn
    def _edit_objects(self, edit: Edit) -> None:
        self.change(dataclasses.replace(self.scene, objects=tuple(edit(self.scene.objects))))

    def _go_on(self, other: Pipeline) -> None:
        """Take over another pipeline's track, if it fits, and its estimates from frames."""
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
        """Take the next frame for one of a clip that starts at 0 seconds, as if no other had been lit before it.

        Pictures of a part of a clip then are those that the whole clip gives, and do not depend on what the pipeline
        was used for before. That needs a light that is given: an environment that is gathered over frames is not. So
        are the poses, where the next frame is not the clip's first.

        Args:
            saturation: Codes at which the camera's channels saturate, (3,), where they are known; they then hold for
                all frames to come.

        Raises:
            UsageError: The scene's light is that of a mirror ball in the frames.
        """
        self._check_usable()
        self._finish()
        if self.plan.features.observed:
            raise UsageError("restart needs a captured light: a mirror ball's is gathered over the frames before")
        self._begun, self._start_time, self._last_time = 0, 0.0, 0.0
        self._lit_time = math.inf  # no frame came before
        self._shown = None
        if self._tracker is not None:
            self._tracker.reset()
        self.inputs.forget_drift()
        if saturation is not None:
            self.inputs.fix_saturation(saturation)
        self._scheduler.restart()

    @_in_turn
    def start_clock(self, seconds: float) -> None:
        """Have animations begin at a time before the first frame; left out, they begin with it.

        Args:
            seconds: On the clock of ``time_seconds``.

        Raises:
            UsageError: A frame has been lit, the pipeline is closed, or the time is not finite.
        """
        self._check_usable()
        check_number("seconds", seconds)
        if self._begun:
            raise UsageError("start_clock comes before the first frame")
        self._start_time = self._last_time = seconds
        self._lit_time = math.inf  # no frame came before

    @_in_turn
    def take_light(self, radiance: npt.NDArray[np.float32], emitters: npt.NDArray[Any] | None = None) -> None:
        """Light the frames to come by another environment than the captured one that the scene names.

        Args:
            radiance: Linear RGB in the scene's axes, float32 (height, 2 height, 3), of the quality's
                ``environment_height``; it is kept, not copied.
            emitters: Where its emitters are: the array ``emitters`` of a pipeline that found them, copied.

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
            image: uint8 RGB (height, width, 3) of NumPy or of whatever has ``__dlpack__`` or
                ``__cuda_array_interface__`` (torch, JAX, CuPy), or a Warp array (height, width) of ``wp.vec3ub``. It
                lies on the host or on the pipeline's device, where it is read without a copy to the host unless the
                marker must be found; on a CUDA device it must stay as it is until it has been rendered. A pipeline of
                ``linear`` frames takes uint16 codes, linear floats and a `Plate` too.
            time_seconds: When the frame was taken; frames without a time are taken to come 30 times a second.
            pose: ``camera_from_world`` where it is known from elsewhere, or what a tracker of the caller's told of the
                frame; the marker is then not looked for.
            exposure_time: Seconds; None means that of the frames that are shown.

        Raises:
            UsageError: The image has another size or type, a number is not finite, the pipeline is closed, or it is
                another process's.
        """
        return self._begin(image, time_seconds, pose, exposure_time, ahead=False)

    def new_frame(self) -> Image:
        """Memory for a frame to ``submit``, for a source to write the frame into.

        On CUDA it is pinned: the frame is sent from there, where any other is copied to such memory first. Once it has
        been submitted it must stay as it is; ask for another for the next frame. It is given again when nobody refers
        to it any more. Who holds more than 512 MB of them gets ordinary memory.

        Returns:
            uint8 (height, width, 3), of any values; also of a pipeline that has been closed meanwhile.
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
        """Light one frame without waiting for it; arguments as those of a call.

        This thread looks for the marker. On CUDA it sends and launches the frame, and its picture is sent ahead; on CPU
        another thread renders it. With the next frame submitted before this one's image is read, tracking, both ways
        over the bus and the kernels run side by side. The device's own
        arrays of a result still hold only until the next frame is rendered.
        An image that may not be written (``flags.writeable``) is taken to stay as it is, and not copied on CPU; on CUDA
        one that ``new_frame`` gave is not.
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
        """Look at a frame and have it rendered, by this thread or, if ``ahead``, by another where it is the host's."""
        self._check_usable()
        if time_seconds is not None:
            check_number("time_seconds", time_seconds)
        if exposure_time is not None:
            check_number("exposure_time", exposure_time, above=0.0)
        pose = given.pose if isinstance(given, Track) else given
        if pose is not None and not isinstance(pose, Pose):
            raise UsageError(f"pose is {type(pose).__name__}; expected a Pose(R, t), camera_from_world, or a Track")
        plate, image = self._take_depth(image)
        picture = adopt_frame(image, self.size, self.device)
        result = self._light_frame(picture, time_seconds, given, exposure_time, ahead=ahead, plate=plate)
        if picture is not image and isinstance(picture, wp.array):
            self._borrowed.keep(picture)
        return result

    def _take_depth(self, image: Any) -> tuple[Plate | None, Any]:
        """Return the part of a frame beyond 8 bits, None if there is none, and its 8-bit codes."""
        if not self.plan.request.linear:
            if isinstance(image, np.ndarray) and image.dtype != np.uint8 and image.dtype.kind in "uf":
                width, height = self.size
                right = f"uint8 RGB ({height}, {width}, 3), or a pipeline made with linear=True"
                raise UsageError(f"frame is {image.dtype} {image.shape}; expected {right}")
            return None, image
        transfer = str(self.camera.transfer)
        if isinstance(image, np.ndarray) and image.dtype == np.uint8:
            return Plate(image.astype(np.uint16) * np.uint16(257)), image
        plate = image if isinstance(image, Plate) else as_plate(np.asarray(image), self.size)
        check_plate(plate.picture, self.size)
        return plate, codes8(plate, transfer) if plate.codes is None else plate.codes

    def _light_frame(
        self,
        image: Any,
        time_seconds: float | None,
        pose: Pose | Track | None,
        exposure_time: float | None,
        *,
        ahead: bool,
        plate: Plate | None = None,
    ) -> Result:
        """Have a frame rendered whose arguments are in order."""
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
            return self._take_short(image, host_image, exposure, now, pose)
        frame, state = self._look(image if host_image is None else host_image, now, pose, plate)
        if handed_over:
            return Result(frame.pose, state, self._hand_over(frame))
        rendered = self._render(self._send(frame))
        return Result(frame.pose, state, (self._keep(rendered) if ahead else rendered).at_once())

    def _send(self, frame: SeenFrame) -> SeenFrame:
        """Send a frame to the device, unless it is already there."""
        if self.inputs.transfers is None or frame.lost or isinstance(frame.image, wp.array):
            return frame
        frame.slot = self.inputs.transfers.upload(frame.image)
        return frame

    def _hand_over(self, frame: SeenFrame) -> Future[Rendered]:
        """Have a frame of the host rendered: on CUDA launched by this thread, on CPU by another."""
        while len(self._ahead) >= AHEAD:
            self._ahead.popleft().result()
        frame = self._send(frame)
        if frame.lost or not self._launches_here:
            # The caller may write its picture anew before it is rendered, unless nobody may.
            if frame.slot is not None and "image" in self._arrays:
                frame.image = frame.slot.host  # no other comes there before this one is rendered: see ``AHEAD``
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
        """Wait until all that was submitted is rendered."""
        while self._ahead:
            self._ahead.popleft().result()

    def _keep(self, rendered: Rendered) -> Rendered:
        """Have the picture outlast the next frame; the light as well, on CPU and where no picture is made."""
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
        """Find the marker, unless the pose is known or nothing needs it."""
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
        """Find the markers that something rides on."""
        if not self._own_markers:
            return {}
        if isinstance(image, wp.array):
            with exclusive(self.device):
                image = image.numpy()
        start = time.perf_counter()
        places = self._own_markers.track(cast(Image, image), now, pose)
        before = timings[TRACK].milliseconds if TRACK in timings else 0.0
        timings[TRACK] = StageTiming(before + (time.perf_counter() - start) * 1e3, False)
        return places

    def _look(
        self, image: Any, now: float, given: Pose | Track | None, plate: Plate | None
    ) -> tuple[SeenFrame, TrackState | None]:
        """Find the marker, go on with the clock."""
        timings: dict[str, StageTiming] = {}
        pose, state = self._track(image, now, given, timings)
        lost = pose is None and (self._tracker is not None or isinstance(given, Track))
        places = self._find_own_markers(image, now, pose, timings)
        seconds, step = now - (self._start_time or 0.0), max(now - self._lit_time, 0.0)
        self._last_time = self._lit_time = now
        self._index += 1
        return SeenFrame(image, None, pose, lost, self._index - 1, now, seconds, step, timings, places, plate), state

    def _render(self, frame: SeenFrame) -> Rendered:
        """Run the stages on a frame."""
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
        # A lost marker says nothing about where objects are: the frame passes as it came, the last light is kept.
        self._shown = frame.image if frame.lost or "image" not in self._arrays else self._arrays["image"]
        layers = self._layers_of(frame.image if frame.lost else None)
        if layers is not None and frame.plate is not None:
            clip = frame.plate.clip_levels(str(self.camera.transfer), self.inputs.saturation.levels)[0]
            layers = layers.with_plate(self.inputs.radiance(frame.plate), clip)
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
        """The layers that were asked for; those of a frame that passes as it came are neutral."""
        request = self.plan.request
        if not request.asks_for_layers:
            return None
        if unlit is not None:
            return neutral_layers(request, unlit, self.inputs.decode)
        return layer_arrays(request, self._arrays)

    def _take_short(
        self, image: Any, host_image: Image | None, exposure: int | None, now: float, given: Pose | Track | None
    ) -> Result:
        """Let a frame of another exposure tell of the light, unless that was left out; the picture stays."""
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
                self._short.take(image, exposure, pose, self.inputs.block.host("params"), now)
            timings["unwrap"] = StageTiming((time.perf_counter() - start) * 1e3, False)
        self._last_time = now
        shown = bright if self._shown is None else self._shown
        layers = self._layers_of(bright if self._shown is None else None)
        light = self._light
        rendered = self._keep(Rendered(shown, light.environment, timings, layers=layers, others_array=light.others))
        return Result(pose, state, rendered.at_once(), shown=False)
