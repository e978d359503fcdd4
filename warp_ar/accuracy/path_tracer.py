"""Progressive path tracing of a frame, with a standard error for every pixel.

``kernels/reference/path_tracer.py`` and ``path_following.py`` define the integral that is estimated. The inputs are
those of the pipeline: the scene, the light of the environment, and one frame with its pose. Given these, the path
tracer makes no approximation, so that with enough samples it is the reference for the pipeline's methods.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive, resolve_device, translating, usable_cores
from warp_ar.errors import UsageError
from warp_ar.kernels import structs
from warp_ar.kernels.color import decode_table, encode_table
from warp_ar.kernels.reference import path_picture, path_tracer
from warp_ar.kernels.reference.path_photons import (
    follow_lights,
    follows_lights,
    is_polished_one,
    make_light_image,
    spheres_around,
)
from warp_ar.kernels.reference.path_sampling import make_sky
from warp_ar.kernels.reference.path_vertices import LocalScene
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.light.captured import Light, placed_emitters
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import trace_config
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.scene.ray_scene import HostScene
from warp_ar.stages.shared.lighting import trace_variant

FloatImage = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]

DEFAULT_SAMPLES = 256
"""Default number of samples per pixel."""
LIGHT_SAMPLES = 32
"""Default number of samples per pixel for the reflectance of proxies, which is estimated before the picture."""
FIRST_LIGHT_SAMPLES = 4
"""Number of these samples after which each proxy's mean reflectance is first estimated."""
UNKNOWN_REFLECTANCE = 0.5
"""Reflectance of a proxy that is visible in no pixel."""
DFG_SIZE = 32
"""Rows and columns of the table of directional albedo."""
PART = 2048
"""Number of samples that a CPU thread traces at a time."""
MOST_SAMPLES = 1 << 21
"""Largest number of samples of a round on CPU."""
MOST_CUDA_SAMPLES = 1 << 25
"""Largest number of samples of a round on a GPU, if its free memory has ``SAMPLE_BYTES`` for each."""
SAMPLE_BYTES = 512
"""Number of free bytes required for each sample of a round, which is several times the bytes it uses."""
PATHS_OF_LIGHTS = 0.25
"""Number of paths from virtual lights per pixel and pass (one sample per pixel); there are as many from near
emitters."""
FIRST_ROUND = 16
"""Number of samples per pixel after which samples are first distributed by the noise; it is repeated at each
doubling."""
AROUND = 9
"""Side in pixels of the square over which a pixel's noise is averaged."""
LEAST_SHARE, MOST_SHARE = 0.25, 32.0
"""Bounds of a pixel's number of samples relative to the mean. With the lower one, pixels without noise so far still get
samples, which may find rare light."""
LEAST_CHANGE = 1e-4
"""Smallest difference from the linear frame of a pixel that shows something virtual."""


@dataclasses.dataclass(frozen=True)
class TracedPicture:
    """Picture of the samples so far, with its standard error."""

    radiance: FloatImage
    """Linear radiance, unclipped, in units of the camera's clipping, (H, W, 3)."""
    error: FloatImage
    """Standard error of ``radiance``, (H, W, 3)."""
    image: Image
    """Picture as the camera would have encoded it at the scene's exposure, (H, W, 3) RGB."""
    samples: int
    """Mean number of samples per pixel."""
    seconds: float
    """Total seconds that sampling took."""
    relative_error: float
    """RMS of the standard error divided by RMS of the radiance, over pixels that virtual objects and lights change. The
    error of a pixel that clips is reduced to the visible part."""


def _relative_error(picture: FloatImage, error: FloatImage, frame: FloatImage | None) -> float:
    changed = _changed(picture, error, frame)
    noise = _seen_noise(picture, error)[changed]
    signal = np.clip(picture, 0.0, 1.0)[changed].astype(np.float64)
    if not signal.size or not signal.any():
        return 0.0
    return float(np.sqrt((noise**2).mean() / (signal**2).mean()))


def _changed(picture: FloatImage, error: FloatImage, frame: FloatImage | None) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels that virtual objects and lights change, (H, W)."""
    if frame is None:
        return np.ones(picture.shape[:2], bool)
    return np.asarray((np.abs(picture - frame) > LEAST_CHANGE).any(axis=2) | (error > LEAST_CHANGE).any(axis=2))


def _seen_noise(picture: FloatImage, error: FloatImage) -> npt.NDArray[np.float64]:
    """Return the visible standard error, (H, W, 3): 0 where the radiance clips by more than it, and at most 1."""
    return np.where(picture - error > 1.0, 0.0, np.minimum(error, 1.0)).astype(np.float64)


# Let pixel i have n_i of N samples, and let v_i be the variance of one sample in it. The variance of the picture is the
# sum of v_i / n_i. It is least for n_i in proportion to the square root of v_i. The neighbours give the estimate of
# v_i. If a pixel's own samples decided how many more it gets, its mean would be biased, because sampling would continue
# until a bright sample came. Only neighbours with the same kind of surface are used, because the noise of an object
# differs from that of the desk next to it.
def sample_shares(
    picture: FloatImage, error: FloatImage, samples: npt.NDArray[np.int32], proxies: FloatImage
) -> FloatImage:
    """Return the number of samples of each pixel in a pass, (H, W) with mean 1, by the noise of surrounding pixels.

    Args:
        picture: Linear radiance, (H, W, 3).
        error: Standard error of the radiance, (H, W, 3).
        samples: Number of samples of each pixel so far, (H, W).
        proxies: Share of each pixel's samples that show a proxy, (H, W).
    """
    variance = (_seen_noise(picture, error) ** 2).mean(axis=2) * samples
    deviation = np.zeros(variance.shape)
    for own in (proxies > 0.5, proxies <= 0.5):
        counted = np.where(own, variance, 0.0)
        sums, others = (
            cv2.boxFilter(values, -1, (AROUND, AROUND), normalize=False, borderType=cv2.BORDER_CONSTANT) - values
            for values in (counted, own.astype(np.float64))
        )
        deviation[own] = np.sqrt(np.maximum(sums, 0.0) / np.maximum(others, 1.0))[own]
    mean = deviation.mean()
    if not mean > 0.0:
        return np.ones(variance.shape, np.float32)
    shares = np.clip(deviation / mean, LEAST_SHARE, MOST_SHARE)
    return np.asarray(shares / shares.mean(), np.float32)


class PathTracer:
    """Path tracer of one frame of a scene.

    ``sample`` adds samples; ``picture`` returns the result of all samples so far. On one device, equal arguments and
    seeds give a bit-identical picture, in however many steps samples are added.
    """

    def __init__(
        self,
        scene: Scene,
        light: Light | FloatImage,
        frame: Image | FloatImage | None,
        pose: Pose,
        *,
        device: str = "auto",
        size: tuple[int, int] | None = None,
        seconds: float = 0.0,
        seed: int = 0,
        reflectances: tuple[tuple[float, float, float], ...] | None = None,
        light_samples: int = LIGHT_SAMPLES,
    ) -> None:
        """Copy scene, light and frame to the device.

        Args:
            scene: Scene to trace.
            light: Environment in the world's axes: latlong radiance (h, 2 h, 3) in units of the camera's clipping, or a
                captured light, whose emitters are placed at their distances if these are known.
            frame: Camera frame without anything virtual, (H, W, 3): encoded (uint8) or linear (float32). None: the
                picture shows the whole scene, including the environment and the physical surfaces, which have
                ``reflectances``.
            pose: ``camera_from_world``.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            size: Width and height of the picture; None means the camera's. The frame is averaged to this size.
            seconds: Time since the first frame, for animations.
            seed: Seed of the random numbers, 0 or more.
            reflectances: RGB reflectance of each proxy if there is no frame; None: 0.5.
            light_samples: Number of samples per pixel for the reflectance of proxies, above ``FIRST_LIGHT_SAMPLES``.

        Raises:
            UsageError: The frame, the light, the seed or the reflectances cannot be used.
            SceneError: The camera cannot be scaled to ``size``.
        """
        if not 0 <= seed < 2**31:
            raise UsageError(f"seed = {seed}: expected 0 to {2**31 - 1}")
        self.camera = scene.camera if size is None else scene.camera.scaled_to(*size)
        self.scene = dataclasses.replace(scene, camera=self.camera)
        self.device = resolve_device(device)
        self.seed, self.samples = seed, 0
        self.light_samples = light_samples
        scale = scene.exposure.scale
        self.exposure = scale if isinstance(scale, float) else 1.0
        self._seconds = 0.0
        self._followed = 0
        """Number of passes of paths from virtual lights so far."""
        self._work, self._sliced, self._goal = self._all_work(), False, 0
        """Remaining work; True if it is done pass by pass; and otherwise the number of samples per pixel to reach."""
        self._compiled: set[str] = set()
        self._prepared = False
        self._passes = 0
        """Number of passes since samples were last distributed among pixels."""
        self._linear = None if frame is None else _linear_frame(frame, self.camera)
        self._config = trace_variant(trace_config(scene), self.device)
        near = placed_emitters(light.emitters if isinstance(light, Light) else ())
        with translating(self.device), wp.ScopedDevice(self.device):
            self._host = HostScene(self.scene, self.device)
            self._local = self._make_local(_environment(light), near, seconds)
            self._params = wp.array(self._camera_values(pose), dtype=structs.FrameParams, device=self.device)
            self._set_reflectances(reflectances)
            self._allocate()
        self._part, self._most = PART, MOST_SAMPLES
        if not self.device.is_cpu:
            self._part = self._most = max(1, min(MOST_CUDA_SAMPLES, self.device.free_memory // SAMPLE_BYTES))

    def _allocate(self) -> None:
        """Allocate the moments (sums over samples), which are 0, and the arrays of the picture."""
        shape = (self.camera.height, self.camera.width)
        self._moments = path_picture.make_moments(shape, self.device)
        self._round = path_picture.make_round(shape, self.device)
        self._shares = wp.ones(shape, dtype=wp.float32, device=self.device)
        self._image_of_lights = make_light_image(
            shape if self._follows_lights or self._follows_emitters else (0, 0), self.device
        )
        self._sampled = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        self._radiance = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        self._error = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        self._image = wp.zeros(shape, dtype=wp.vec3ub, device=self.device)
        self._encode = wp.array(encode_table(self.camera.transfer), dtype=wp.vec3, device=self.device)

    def _make_local(self, radiance: FloatImage, emitters: npt.NDArray[Any], seconds: float) -> Any:
        """Return the scene in the form that kernels intersect with paths.

        Args:
            radiance: Environment, latlong (h, 2 h, 3).
            emitters: Records of the emitters with known distances.
            seconds: Time since the first frame.
        """
        local = LocalScene()
        device, shape = self.device, (self.camera.height, self.camera.width)
        objects = np.zeros(self._host.shape_count, structs.struct_dtype(structs.Shape))
        lights = np.zeros(len(self.scene.lights), structs.struct_dtype(structs.Light))
        self._host.write_objects(objects, seconds)
        self._host.write_lights(lights, seconds)
        # Paths from lights need a frame: without one, the first surface's reflectance is a factor of each path, not of
        # their sum.
        materials, known = self._host.ray_scene.materials.numpy(), self._linear is not None
        self._follows_lights = known and follows_lights(lights, objects, materials)
        local.rays = self._host.ray_scene
        local.rays.objects = wp.array(objects, dtype=structs.Shape, device=device)
        local.lights = wp.array(lights, dtype=structs.Light, device=device)
        local.lights_followed = self._follows_lights
        balls = np.zeros(len(self.scene.probes), structs.struct_dtype(structs.Probe))
        for ball, probe in zip(balls, self.scene.probes, strict=True):
            ball["center"], ball["radius"], ball["reflectance"] = probe.center, probe.radius, probe.reflectance
        local.probes = wp.array(balls, dtype=structs.Probe, device=device)
        if self.scene.has_gloss:
            gloss = np.zeros((len(self.scene.proxies), 4), np.float32)
            for record, proxy in zip(gloss, self.scene.proxies, strict=True):
                if proxy.material is not None:
                    record[:] = *proxy.material.reflectance, proxy.material.roughness
            local.gloss = wp.array(gloss, dtype=wp.vec4, device=device)
        local.sky = make_sky(radiance, device, emitters)
        self._follows_emitters = known and local.sky.near_share > 0.0 and is_polished_one(objects, materials)
        local.near_followed = self._follows_emitters
        local.spheres = wp.array(spheres_around(objects), dtype=wp.vec4, device=device)
        local.dfg = wp.zeros((DFG_SIZE, DFG_SIZE), dtype=wp.vec2, device=device)
        integrate_dfg(local.dfg)
        rays = wp.array(pixel_rays(self.camera), dtype=wp.vec2, device=device)
        local.picture = structs.make_picture(wp.zeros(shape, dtype=wp.vec3ub, device=device), None, rays)
        if self._linear is not None:
            local.radiance = local.matt = wp.array(self._linear, dtype=wp.vec3, device=device)
            if self.scene.has_gloss:
                local.matt = wp.array(self._linear, dtype=wp.vec3, device=device)
            local.reflectance = wp.zeros(shape, dtype=wp.vec3, device=device)
            local.shown = wp.full(shape, -1, dtype=wp.int32, device=device)
        return local

    def _camera_values(self, pose: Pose) -> npt.NDArray[Any]:
        params = np.zeros(1, structs.struct_dtype(structs.FrameParams))
        inverse = pose.inverse()
        params["camera_position"], params["world_from_camera"] = inverse.translation, inverse.rotation
        params["focal"] = self.camera.fx, self.camera.fy
        params["principal"] = self.camera.cx, self.camera.cy
        params["distortion"] = np.resize(np.asarray([*self.camera.distortion, *([0.0] * 8)], np.float32), 8)
        return params

    def _set_reflectances(self, reflectances: Sequence[Any] | None) -> None:
        count = len(self.scene.proxies)
        if reflectances is None:
            reflectances = [(UNKNOWN_REFLECTANCE,) * 3] * count
        if len(reflectances) != count:
            raise UsageError(f"{len(reflectances)} reflectances for {count} proxies: expected one for each")
        values = np.asarray(reflectances, np.float32).reshape(count, 3)
        self._local.proxy_reflectance = wp.array(values, dtype=wp.vec3, device=self.device)

    def _trace(self, asked: int, first: int, count: int) -> Iterator[None]:
        """Trace passes in rounds as large as memory allows, each in parts that run in parallel on the cores.

        Args:
            asked: Quantity to estimate, a constant of the kernels' ``path_tracer``.
            first: Index in the random sequence of a pixel's first sample in the moments.
            count: Number of passes.
        """

        def trace(part: tuple[int, int]) -> None:
            numbers = asked, self.seed, first
            given = self._params, self._local, *numbers, self._moments.samples, self._round
            path_tracer.trace_paths(self._config, *given, rows=part)

        while count > 0:
            room = self._most // (self.camera.width * self.camera.height)
            passes = 1 if self._sliced else min(count, max(1, room))
            with translating(self.device), wp.ScopedDevice(self.device):
                path_picture.list_samples(self._shares, self._round, seed=self.seed, begun=self._passes, count=passes)
            yield from self._in_parts("paths", trace, self._round.count)
            with translating(self.device), wp.ScopedDevice(self.device):
                path_picture.add_samples(self._round, self._moments)
            self._passes += passes
            count -= passes
            if asked == path_tracer.DIFFERENCE and (self._follows_lights or self._follows_emitters):
                for _ in range(passes):
                    yield from self._follow_lights()

    def _follow_lights(self) -> Iterator[None]:
        """Trace the paths of a pass from virtual lights and near emitters, in parts."""
        each = self._paths_of_each()
        of_lights = each if self._follows_lights else 0
        count = of_lights + (each if self._follows_emitters else 0)

        def trace(part: tuple[int, int]) -> None:
            numbers = self.seed, self._followed, count, of_lights
            follow_lights(self._config, self._params, self._local, *numbers, self._image_of_lights, rows=part)

        yield from self._in_parts("lights", trace, count)
        self._followed += 1

    def _paths_of_each(self) -> int:
        """Return the number of paths of a pass from virtual lights; the number from near emitters is equal."""
        return math.ceil(PATHS_OF_LIGHTS * self.camera.width * self.camera.height)

    def _in_parts(self, kind: str, trace: Callable[[tuple[int, int]], None], count: int) -> Iterator[None]:
        """Trace samples or paths in parts on all cores; if work is done pass by pass, yield after one part per core.

        Args:
            kind: Name of the kernel, which is compiled by the first part.
            trace: Function that traces a range of threads of the kernel.
            count: Number of threads.
        """
        parts = [(start, min(start + self._part, count)) for start in range(0, count, self._part)]
        if len(parts) == 1 or (parts and kind not in self._compiled):
            with translating(self.device), wp.ScopedDevice(self.device):
                trace(parts.pop(0))  # compiles the kernel before several threads need it
            self._compiled.add(kind)
            yield
        at_once = usable_cores() if self._sliced else max(len(parts), 1)
        with ThreadPoolExecutor(usable_cores(), "warp_ar-paths") as pool:
            for start in range(0, len(parts), at_once):
                list(pool.map(trace, parts[start : start + at_once]))
                yield

    def _all_work(self) -> Iterator[bool]:
        """Do the work without end; yield after each part: True if passes over all pixels are complete, else False."""
        asked = path_tracer.WHOLE
        if self._linear is not None:
            asked = path_tracer.DIFFERENCE
            with translating(self.device), wp.ScopedDevice(self.device):
                path_tracer.find_shown(self._config, self._params, self._local, self._local.shown)
            first = 0
            for count in (FIRST_LIGHT_SAMPLES, self.light_samples - FIRST_LIGHT_SAMPLES):
                for _ in self._trace(path_tracer.IRRADIANCE, first, count):
                    yield False
                first += count
                with translating(self.device), wp.ScopedDevice(self.device):
                    self._map_reflectance()
        self._prepared = True
        yield False
        while True:
            self._share()
            due = FIRST_ROUND
            while due <= self.samples:
                due *= 2
            count = 1 if self._sliced else min(self._goal, due) - self.samples
            for _ in self._trace(asked, self.light_samples, count):
                yield False
            self.samples += count
            yield True

    def prepare(self) -> None:
        """Estimate the reflectance of proxies, if this was not done yet; ``sample`` calls this method."""
        self._sliced = False
        while not self._prepared:
            next(self._work)

    def _map_reflectance(self) -> None:
        """Compute reflectance from the light in the moments, and clear the moments."""
        path_picture.map_reflectance(self._local, self._moments, self._local.reflectance)
        found, shown = self._local.reflectance.numpy(), self._local.shown.numpy()
        means = [
            found[shown == k].mean(axis=0) if (shown == k).any() else np.full(3, UNKNOWN_REFLECTANCE)
            for k in range(len(self.scene.proxies))
        ]
        self._set_reflectances(means)
        self._moments = path_picture.make_moments(shown.shape, self.device)
        self._passes = 0

    def _share(self) -> None:
        """Distribute the next samples by the noise so far; this is done after ``FIRST_ROUND`` and each doubling."""
        rounds, rest = divmod(self.samples, FIRST_ROUND)
        if rest or not rounds or rounds & (rounds - 1):
            return
        moments = self._moments
        with exclusive(self.device), wp.ScopedDevice(self.device):
            self._finish()
            found = (np.array(a.numpy()) for a in (self._radiance, self._sampled, moments.samples, moments.proxies))
            self._shares = wp.array(sample_shares(*found), dtype=wp.float32, device=self.device)
        self._passes = 0

    def _finish(self) -> None:
        """Compute picture and error from the moments."""
        kinds = int(self._follows_lights) + int(self._follows_emitters)
        followed = self._followed * kinds * self._paths_of_each() / (self.camera.width * self.camera.height)
        given = self._local.matt, self._encode, self._moments, self._image_of_lights, followed, self.exposure
        path_picture.finish_picture(*given, self._radiance, self._error, self._sampled, self._image)

    def sample(self, count: int) -> None:
        """Add ``count`` samples per pixel on average; after ``FIRST_ROUND``, noisy neighbourhoods get more of them.

        Raises:
            UsageError: The count is not positive.
        """
        if count < 1:
            raise UsageError(f"{count} samples: expected 1 or more")
        self.prepare()
        start = time.perf_counter()
        self._goal = self.samples + count
        while self.samples < self._goal:
            next(self._work)
        with exclusive(self.device):
            wp.synchronize_device(self.device)
        self._seconds += time.perf_counter() - start

    def sample_for(self, seconds: float) -> bool:
        """Add samples for about the given time, in small parts.

        After each complete pass, the picture equals that of ``sample`` with as many samples.

        Returns:
            True if a pass over the whole picture was completed.
        """
        start, ended, self._sliced = time.perf_counter(), False, True
        while True:
            ended |= next(self._work)
            with exclusive(self.device):
                wp.synchronize_device(self.device)
            spent = time.perf_counter() - start
            if spent >= seconds:
                self._seconds += spent
                return ended

    def picture(self) -> TracedPicture:
        """Return the picture of the samples so far.

        Raises:
            UsageError: There are no samples yet.
        """
        if self.samples < 1:
            raise UsageError("no samples yet: call sample() first")
        with exclusive(self.device):
            self._finish()
            radiance, error, image = (np.array(a.numpy()) for a in (self._radiance, self._error, self._image))
        relative = _relative_error(radiance, error, self._linear)
        return TracedPicture(radiance, error, image, self.samples, self._seconds, relative)

    def shown(self) -> npt.NDArray[np.int32]:
        """Return the index of the only proxy that the frame shows in each pixel, (H, W); -1 for none or several."""
        self.prepare()
        with exclusive(self.device):
            return np.array(self._local.shown.numpy())

    def reflectance(self) -> FloatImage:
        """Return the reflectance of the proxy in each pixel, (H, W, 3), estimated from frame and light; 0 elsewhere."""
        self.prepare()
        with exclusive(self.device):
            return np.array(self._local.reflectance.numpy())

    def frame(self) -> FloatImage:
        """Return the linear frame at the picture's size, (H, W, 3).

        Raises:
            UsageError: The tracer has no frame.
        """
        if self._linear is None:
            raise UsageError("this path tracer has no frame")
        return self._linear

    def rays(self) -> int:
        """Return the number of rays that were traced so far."""
        with exclusive(self.device):
            rays = self._moments.rays.numpy().astype(np.int64).sum() + self._image_of_lights.rays.numpy().sum()
        return int(rays)

    def render(
        self,
        samples: int = DEFAULT_SAMPLES,
        *,
        error: float | None = None,
        step: int = 16,
    ) -> Iterator[TracedPicture]:
        """Yield pictures with ever more samples, one per ``step`` samples per pixel.

        Args:
            samples: Samples per pixel at which to stop.
            error: Relative standard error at which to stop earlier; None: no limit.
            step: Samples per pixel between two pictures.
        """
        while self.samples < samples:
            self.sample(min(step, samples - self.samples))
            picture = self.picture()
            yield picture
            if error is not None and picture.samples >= min(2 * step, samples) and picture.relative_error <= error:
                return


def _environment(light: Light | FloatImage) -> FloatImage:
    radiance = light.radiance if isinstance(light, Light) else np.asarray(light, np.float32)
    if radiance.ndim != 3 or radiance.shape[2] != 3 or min(radiance.shape[:2]) < 2:
        raise UsageError(f"light has the shape {radiance.shape}: expected latlong radiance (h, 2 h, 3)")
    return radiance


def _linear_frame(frame: Image | FloatImage, camera: Any) -> FloatImage:
    """Return the linear radiance of a frame, (H, W, 3), averaged to the camera's size.

    Raises:
        UsageError: The frame has another type or aspect ratio.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype not in (np.uint8, np.float32):
        raise UsageError(f"frame is {frame.dtype} {frame.shape}: expected uint8 or float32 (height, width, 3)")
    linear = frame
    if frame.dtype == np.uint8:
        table = decode_table(camera.transfer)
        linear = np.stack([table[frame[..., c], c] for c in range(3)], axis=-1)
    size = (camera.width, camera.height)
    if frame.shape[1::-1] != size:
        if frame.shape[1] * size[1] != frame.shape[0] * size[0]:
            raise UsageError(
                f"frame is {frame.shape[1]}x{frame.shape[0]}, the picture {size[0]}x{size[1]}: another aspect ratio"
            )
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(linear, np.float32)
