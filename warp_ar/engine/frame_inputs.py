"""Inputs of every frame that the pipeline provides: the picture, the camera, virtual lights and objects, the clock."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import struct
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar import scene as scenes
from warp_ar.ball.ball_occlusion import BallOcclusion
from warp_ar.ball.reflectance_watch import ReflectanceWatch
from warp_ar.calibration.saturation import PERIOD, WATCHED, SaturationLevels, ball_discs
from warp_ar.device import exclusive
from warp_ar.engine.frame_constants import FrameBlock
from warp_ar.engine.graph import INPUTS
from warp_ar.engine.scheduler import StageTiming
from warp_ar.engine.transfer import Slot, Transfers
from warp_ar.kernels.color import camera_table, decode_table, encode_table
from warp_ar.kernels.launch import noting
from warp_ar.kernels.structs import Probe, struct_dtype
from warp_ar.scene import Camera, Pose, Scene
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.scene.ray_scene import HostScene
from warp_ar.scene.screen_extents import EMPTY, Outline, Rect, screen_rects
from warp_ar.sources.deep_frame import DeepFrame, decode_deep
from warp_ar.stages.base import Arrays, Reach, Rows
from warp_ar.tracking.drift import ExposureDrift
from warp_ar.tracking.tracking import Places

_CLOCK = struct.Struct("<2fi")
"""Layout of the frame constants ``time``, ``time_step`` and ``environment_reset``."""
_ALL_RECTS = ("object", "light", "direct", "shadow", "ball")
"""Names of the screen rectangles, in their order in the frame constants."""
RECTS = ("object", "light", "shadow", "ball")
"""Names of the screen rectangles that limit the rows of passes. The frame constants hold each rectangle's rows and
columns."""


@dataclasses.dataclass(slots=True)
class SeenFrame:
    """Frame whose pose has been found, before it is rendered."""

    image: Any
    """Image of the caller, or a copy of it."""
    slot: Slot | None
    """Slot of ``Transfers`` that holds the image, if the transfer to the device has begun; else None."""
    pose: Pose | None
    """``camera_from_world``; None if lost or not needed."""
    lost: bool
    """True if a pose is needed but unknown."""
    index: int
    """Number of frames before this one since the arrays were allocated."""
    time: float
    """Time of the frame on the caller's clock, seconds."""
    seconds: float
    """Seconds since the start of animations, which is the first frame or the time given to ``start_clock``."""
    step: float
    """Seconds since the previous lit frame."""
    timings: dict[str, StageTiming]
    """Time of tracking."""
    places: Places = dataclasses.field(default_factory=dict)
    """Poses of the markers to which objects, lights or other parts of the scene are attached."""
    deep: DeepFrame | None = None
    """Frame at its full bit depth; None for 8-bit frames."""


class FrameInputs:
    """Inputs of the stages. They are written before a frame is rendered; those that changed get a new version."""

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        arrays: Arrays,
        device: Any,
        *,
        follows_gain: bool = False,
        watches_ball: bool = False,
        linear: bool = False,
    ) -> None:
        """Allocate the inputs and add them to ``arrays``.

        Args:
            scene: Scene to show.
            camera: Camera of the frames.
            arrays: Arrays of the pipeline, empty.
            device: Warp device, the current one.
            follows_gain: True to estimate drifts of the camera's exposure and white balance.
            watches_ball: True to detect frames in which something covers a ball, and to estimate the balls'
                reflectance.
            linear: True if a stage reads frames as linear radiance.
        """
        shape = (camera.height, camera.width)
        self._camera, self._arrays = camera, arrays
        with noting() as self.first_launches:
            self.host_scene = HostScene(scene, device)
        self.host_scene.set_pixel_spread(1.0 / max(camera.fx, camera.fy))
        self.block = FrameBlock(device, len(scene.lights), self.host_scene.shape_count, len(scene.proxies))
        self.host_scene.ray_scene.objects = self.block.device_array("objects")
        self.host_scene.ray_scene.proxies = self.block.device_array("proxies")
        self.host_scene.write_proxies(self.block.host("proxies"))
        self.block.upload()
        self.frame = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        """Picture that stages read."""
        self.transfers = None if device.is_cpu else Transfers(shape, device)
        self._host_frame = self.frame.numpy() if self.transfers is None else None
        self._linear_frame = wp.zeros(shape if linear else (0, 0), dtype=wp.vec3, device=device)
        self._linear_clip = wp.zeros(2, dtype=wp.vec3, device=device)
        self.decode = decode_table(camera.transfer)
        """Linear value of each 8-bit code, (256, 3)."""
        self.saturation = SaturationLevels()
        """8-bit codes at which the channels saturate, estimated from the frames so far."""
        self._drift = ExposureDrift(scene, camera) if follows_gain and scene.has_marker else None
        watches_ball = watches_ball and scene.has_marker and bool(scene.probes)
        self._occlusion = BallOcclusion(scene, camera) if watches_ball else None
        self._reflectance = ReflectanceWatch(scene, camera, self.decode) if watches_ball else None
        self._coming: Slot | None = None
        self.covered = False
        """True if something covers a ball in this frame, which then does not update the light."""
        self._saturation_is_known = False
        self._encoded = 0.0, self.saturation.levels.copy()
        self._bent = 0.0
        self._probes = scene.probes
        self.rects: dict[str, Rect] = dict.fromkeys(RECTS, (0, shape[0], 0, shape[1]))
        self._written_rects: dict[str, Rect] = dict.fromkeys(_ALL_RECTS, EMPTY)
        # A view of every field, (1, ...), is kept, because NumPy takes longer to look a field up by name than to write.
        values = self.block.host("params")
        self._params = {name: values[name] for name in values.dtype.names}
        self._all_rects = values.view(np.uint8)[values.dtype.fields[f"{_ALL_RECTS[0]}_rect"][1] :].view(np.int32)
        self._clock = values.view(np.uint8)[values.dtype.fields["time"][1] :].data
        self._looked_at: tuple[Any, ...] | None = None
        """Pose and outlines for which the rectangles were last computed."""
        self._shines = True
        self._add(scene, device)
        self._params["focal"][0] = (camera.fx, camera.fy)
        self._params["principal"][0] = (camera.cx, camera.cy)
        self._params["distortion"][0] = np.resize(np.asarray([*camera.distortion, *([0.0] * 8)], np.float32), 8)
        self.write_exposure(scene)

    def _add(self, scene: Scene, device: Any) -> None:
        """Add the arrays of the inputs, and those that all stages share."""
        add, params = self._arrays.add, self._params
        for name in INPUTS:
            add(name, {"frame": self.frame, "linear_frame": self._linear_frame}.get(name))
        add("linear_clip", self._linear_clip)
        add("params", self.block.device_array("params"))
        add("light_array", self.block.device_array("lights"))
        add("ray_scene", self.host_scene.ray_scene)
        add("probes", wp.array(_probe_values(scene.probes), dtype=Probe, device=device))
        add("decode", wp.array(camera_table(self._camera.transfer), dtype=wp.vec3, device=device))
        add("encode", wp.array(encode_table(self._camera.transfer), dtype=wp.vec3, device=device))
        rays = self._arrays.constant(
            self._camera, lambda: wp.array(pixel_rays(self._camera), dtype=wp.vec2, device=device)
        )
        add("rays", rays)
        for name in RECTS:
            add(f"{name}_rows", functools.partial(self._rows, name))
        add("reach", self.reach)
        add("seconds", lambda: float(params["time"][0]))
        add("gain", lambda: self.gain)
        add("ball_covered", lambda: self.covered)
        add("ball_reflectance", lambda: self.told_reflectance)

    @property
    def told_reflectance(self) -> tuple[scenes.RGB, ...] | None:
        """Reflectance of each ball, RGB, estimated from frames; None while the scene's values are used."""
        told = self._reflectance
        return None if told is None or not told.is_told else told.values

    @property
    def gain(self) -> npt.NDArray[np.float64]:
        """Camera's gain relative to the first frame, RGB; 1 if its exposure does not drift."""
        return np.ones(3) if self._drift is None else self._drift.gain

    def look(self, frame: SeenFrame) -> tuple[npt.NDArray[np.float64] | None, bool]:
        """Update the estimates of the camera's gain and of the balls' reflectance, if the frame is on the host.

        Returns:
            Ratio of the new gain to the previous one, RGB, or None if it is unchanged; and True if the estimated tone
            curve or a ball's reflectance has changed, so that the light of earlier frames must be discarded.
        """
        if frame.pose is None or isinstance(frame.image, wp.array):
            return None, False
        ratio, is_bent = self._look_for_drift(frame, frame.pose)
        return ratio, self._note_reflectance(frame, frame.pose) or is_bent

    def _look_for_drift(self, frame: SeenFrame, pose: Pose) -> tuple[npt.NDArray[np.float64] | None, bool]:
        """Update the estimates of the camera's gain and tone curve.

        Returns:
            Ratio of the new gain to the previous one, RGB, or None if it is unchanged; and True if the tone curve has
            changed.
        """
        if self._drift is None:
            return None, False
        gain, contrast = self._drift.gain, self._drift.contrast
        self._drift.saturation = self.saturation.levels
        if not self._drift.observe(frame.image, pose, frame.deep):
            return None, False
        self._have_lights_shine()
        is_bent = contrast != self._drift.contrast
        if is_bent:
            self._write_decode()
        return np.asarray(self._drift.gain / gain), is_bent

    def continue_from(self, other: FrameInputs) -> None:
        """Copy another pipeline's estimates of saturation, gain, tone curve, occlusion of balls and reflectance."""
        if self._camera == other._camera and not self._saturation_is_known:
            self.saturation = copy.deepcopy(other.saturation)
            self._saturation_is_known = other._saturation_is_known
            self._write_decode()
        own, theirs = self._occlusion, other._occlusion
        if own is not None and theirs is not None and own.watches == theirs.watches:
            self._occlusion = copy.copy(theirs)  # a shallow copy suffices: members are replaced, not modified
        mine, yours = self._reflectance, other._reflectance
        if mine is not None and yours is not None and mine.watches == yours.watches:
            self._reflectance = copy.deepcopy(yours)
            self._write_probes()
        if self._drift is None or other._drift is None or self._drift.watches != other._drift.watches:
            return
        self._drift = copy.deepcopy(other._drift)
        self._have_lights_shine()
        if self._drift.contrast != 0.0:
            self._write_decode()

    def forget_drift(self) -> None:
        """Restart the estimate of the camera's gain; it becomes relative to the next frame."""
        if self._drift is None:
            return
        is_bent = self._drift.contrast != 0.0
        self._drift = ExposureDrift(self.host_scene.scene, self._camera)
        self._have_lights_shine()
        if is_bent:
            self._write_decode()

    def _write_decode(self) -> None:
        """Write the tables that decode and encode pixel values, by the estimated saturation and tone curve."""
        contrast, levels = 0.0 if self._drift is None else self._drift.contrast, self.saturation.levels
        self._arrays["decode"].assign(camera_table(self._camera.transfer, levels, contrast))
        if contrast != self._encoded[0] or (contrast != 0.0 and (levels != self._encoded[1]).any()):
            self._arrays["encode"].assign(encode_table(self._camera.transfer, contrast, levels))
            self._encoded = contrast, levels.copy()
        self._have_lights_shine()

    def _have_lights_shine(self) -> None:
        """Set the unit of virtual lights: the largest value at which a channel saturates, times the camera's gain."""
        levels, codes = self.saturation.levels, np.arange(256)
        white = max(float(np.interp(levels[c], codes, self.decode[:, c])) for c in range(3))
        self.host_scene.set_gain(white * self.gain)

    def close(self) -> None:
        """Free the buffers of transfers."""
        if self.transfers is not None:
            self.transfers.close()

    def update(self, scene: Scene, *, placed: bool, exposed: bool) -> None:
        """Use the numbers of another scene from the next frame on.

        Args:
            scene: Scene with the same skeleton.
            placed: True if objects or lights differ.
            exposed: True if the exposure differs.
        """
        if exposed:
            self.write_exposure(scene)
        if placed:
            with exclusive(self.frame.device):
                self.host_scene.update(scene)
            self._arrays.touch("objects")

    def write_exposure(self, scene: Scene) -> None:
        """Write the scale of the exposure, or 1 for ``auto``, which is computed on the device."""
        scale = scene.exposure.scale
        self._params["exposure_scale"][0] = 1.0 if isinstance(scale, str) else scale
        self._arrays.touch("exposure")

    def write(self, frame: SeenFrame, *, reset: bool) -> None:
        """Write the inputs for a frame: its constants, then its picture.

        A picture that is in transfer to the device is copied into the stages' array later, by ``receive``.

        Args:
            frame: Frame whose pose is not lost.
            reset: True if the accumulated environment is discarded.
        """
        self._coming = None  # a frame that failed before it was received may have left a slot
        touched = ["clock", *self._place_probes(frame)]
        self.covered = self._is_covered(frame, reset=reset)
        if not self.covered:
            self._note_saturation(frame)  # must precede the lights, whose unit depends on the saturation
        touched += self._place(frame)
        if (frame.pose is not None and self._move(frame.pose)) or self._arrays.version("pose") == 0:
            touched.append("pose")
        _CLOCK.pack_into(self._clock, 0, frame.seconds, frame.step, reset)
        self.block.upload()
        if self._take_picture(frame):
            touched.append("frame")
        if self._take_deep(frame):
            touched.append("linear_frame")
        for name in dict.fromkeys(touched):
            self._arrays.touch(name)

    def fix_saturation(self, levels: npt.NDArray[np.float64]) -> None:
        """Set the 8-bit values at which channels saturate, (3,), and stop estimating them from frames."""
        self.saturation.levels = np.asarray(levels, np.float64)
        self._saturation_is_known = True
        self._write_decode()

    def _is_covered(self, frame: SeenFrame, *, reset: bool) -> bool:
        """Return True if something covers a ball; always False for a frame that is not on the host."""
        if self._occlusion is None or frame.pose is None or isinstance(frame.image, wp.array):
            return False
        if reset:
            self._occlusion.forget()
        if self._occlusion.rests(frame.seconds):
            return self._occlusion.is_covered
        discs = ball_discs(self._probes, self._camera, frame.pose)
        return self._occlusion.observe(frame.image, discs, frame.pose, frame.seconds, self.gain, frame.deep)

    def _note_reflectance(self, frame: SeenFrame, pose: Pose) -> bool:
        """Update the estimate of the balls' reflectance; return True if the values in use changed."""
        if self._reflectance is None or not self._reflectance.observe(frame.image, pose, self._probes):
            return False
        self._write_probes()
        return True

    def _write_probes(self) -> None:
        """Write the balls' places and their estimated reflectance."""
        told = None if self._reflectance is None else self._reflectance.values
        self._arrays["probes"].assign(_probe_values(self._probes, told))

    def _note_saturation(self, frame: SeenFrame) -> None:
        """Update the estimate of the saturation codes, if the frame is on the host and shows a ball."""
        if self._saturation_is_known or not self._probes or frame.pose is None or isinstance(frame.image, wp.array):
            return
        if frame.index >= WATCHED and frame.index % PERIOD:
            return
        discs = ball_discs(self._probes, self._camera, frame.pose)
        bent = self._drift is not None and self._drift.contrast > 0.0
        if self.saturation.observe(frame.image, discs, float(self.gain.mean()), frame.deep, bent=bent):
            self._write_decode()

    def _place_probes(self, frame: SeenFrame) -> Iterable[str]:
        """Move balls to the poses of their markers; yield the names of changed inputs."""
        scene = self.host_scene
        if frame.pose is not None and scene.place_probes(frame.pose, frame.places):
            self._probes = scene.probes
            self._write_probes()
            yield "pose"

    def _place(self, frame: SeenFrame) -> Iterable[str]:
        """Move lights, objects and proxies to their poses in this frame; yield the names of changed inputs."""
        scene, block, places = self.host_scene, self.block, frame.places
        lights = scene.write_lights(block.host("lights"), frame.seconds, places)
        objects = scene.write_objects(block.host("objects"), frame.seconds, places)
        if scene.write_proxies(block.host("proxies"), places):
            yield "pose"  # every stage that reads the receiver's place also reads the camera's pose
        if lights or frame.index == 0:
            self._shines = scene.has_area_lights or bool(block.host("lights")["intensity"].any())
            yield "lights"
        if objects or frame.index == 0:
            yield "objects"

    def _move(self, pose: Pose) -> bool:
        """Write the camera's pose and the rectangles of virtual objects and lights; return True if the camera moved."""
        outlines = self._outlines()
        looked_at = (pose.rotation.tobytes(), pose.translation.tobytes(), *outlines.values())
        if looked_at == self._looked_at:
            return False
        self._looked_at = looked_at
        position, rotation = self._params["camera_position"], self._params["world_from_camera"]
        before = position.tobytes(), rotation.tobytes()
        inverse = pose.inverse()
        position[0], rotation[0] = inverse.translation, inverse.rotation
        rects = dict(zip(outlines, screen_rects(list(outlines.values()), pose, self._camera), strict=True))
        rects.setdefault("light", rects["direct"])
        self.rects.update(rects)
        self._written_rects.update(rects)
        self._all_rects[:] = list(itertools.chain(*self._written_rects.values()))
        return before != (position.tobytes(), rotation.tobytes())

    def _outlines(self) -> dict[str, Outline]:
        """Return world-space outlines, each under the name of the screen rectangle that is to enclose its projection.

        ``direct`` bounds the direct light of virtual lights. ``light`` also bounds the light that lit surfaces reflect;
        without such light it is left out, and the rectangle of ``direct`` serves instead.
        """
        scene, arrays = self.host_scene, self._arrays
        outlines = {"object": scene.object_outline(), "direct": scene.light_outline()}
        if "relight_bounced" in arrays:
            outlines["light"] = scene.light_outline(bounced=True)
        if "mirror_ball" in arrays or "reflected" in arrays:
            outlines["ball"] = scene.mirror_outline(receivers="reflected" in arrays)
        if "shadow_ratio" in arrays:
            outlines["shadow"] = scene.shadow_outline()
        return outlines

    def _rows(self, name: str) -> Rows:
        """Return the rows of the picture that a rectangle of ``RECTS`` covers in this frame."""
        return self.rects[name][:2]

    def reach(self) -> Reach:
        """Return the parts of this frame that virtual objects and lights can change."""
        rects = (self.rects[name] for name in RECTS)
        objects, light, shadows, balls = (rect[0] < rect[1] and rect[2] < rect[3] for rect in rects)
        falls = bool(self.host_scene.light_outline().polygons)
        return Reach(objects=objects, shines=self._shines, falls=falls, light=light, shadows=shadows, balls=balls)

    def radiance(self, deep: DeepFrame) -> npt.NDArray[np.float32]:
        """Return a deep frame as linear radiance in a new array, (height, width, 3), by the estimated tone curve."""
        contrast = 0.0 if self._drift is None else self._drift.contrast
        if contrast == 0.0 or deep.picture.dtype != np.uint16:
            return deep.radiance(str(self._camera.transfer))
        if self._bent != contrast:
            values, codes = camera_table(self._camera.transfer, contrast=contrast)[:256], np.arange(256) * 257.0
            table = np.stack([np.interp(np.arange(65536.0), codes, values[:, c]) for c in range(3)], -1)
            self._bent, self._bent_table = contrast, table.astype(np.float32)
        return decode_deep(deep.picture, self._bent_table)

    def linear(self, deep: DeepFrame) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the linear radiance of a deep frame, and its ``clip_levels``, (2, 3)."""
        return self.radiance(deep), deep.clip_levels(str(self._camera.transfer), self.saturation.levels)

    def _take_deep(self, frame: SeenFrame) -> bool:
        """Write the frame's linear radiance for the stages; return False if no stage reads it."""
        if frame.deep is None or not self._linear_frame.size:
            return False
        for array, values in zip((self._linear_frame, self._linear_clip), self.linear(frame.deep), strict=True):
            array.assign(values)
        return True

    def receive(self) -> None:
        """Copy an uploaded picture into the stages' array, ahead of the kernels launched from now on."""
        slot, self._coming = self._coming, None
        if slot is not None and self.transfers is not None:
            self.transfers.receive(slot, self.frame)

    def _take_picture(self, frame: SeenFrame) -> bool:
        """Copy the picture; return False if it equals the previous one, so that its readers need not run."""
        if frame.slot is not None:
            self._coming = frame.slot  # ``receive`` waits for it as late as possible, so that transfer and work overlap
        elif isinstance(frame.image, wp.array):
            wp.copy(self.frame, frame.image)
        else:
            assert self._host_frame is not None
            if frame.index and np.array_equal(self._host_frame, frame.image):
                return False
            np.copyto(self._host_frame, frame.image)
        return True


def _probe_values(probes: Sequence[scenes.Probe], reflectances: Sequence[scenes.RGB] | None = None) -> npt.NDArray[Any]:
    """Return records of the balls for kernels, (n,).

    Args:
        probes: The balls at their present places.
        reflectances: Reflectance of each ball; None: the scene's.
    """
    values = np.zeros(len(probes), struct_dtype(Probe))
    told = [probe.reflectance for probe in probes] if reflectances is None else reflectances
    for value, probe, reflectance in zip(values, probes, told, strict=True):
        value["center"], value["radius"], value["reflectance"] = probe.center, probe.radius, reflectance
    return values
