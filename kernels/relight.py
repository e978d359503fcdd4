"""Virtual light on the receiver: linear radiance that a virtual light adds to each pixel of the camera's frame.

Every pixel's ray meets the nearest proxy; the mirror ball, if it is in front, shows no light of its own. A light of
irradiance E_v (facing it) arrives there along wi, unless a virtual object or a proxy stands between, and adds

    added = sum over lights of  Kd / pi * E_v * visible * response.

What Kd and the response are makes the methods, with N.L = max(normal . wi, 0):

``flat``: what plain alpha blending of a lit proxy does. Kd is a grey constant, response = N.L.

``paper``: [DH04] section 4.2 to the letter. The *additive factor* is N.L, the *multiplicative factor* m the intensity
of the video, and alpha "the dot product of the virtual light vector and the brightest physical lighting vector". "When
the dot product is close to one, most of the contribution is from the multiplicative factor, when it is close to zero,
the contribution is from the additive factor, and when it is negative one, the inverse of the multiplicative factor is
used":

    response = (1 - |alpha|) N.L + |alpha| (m if alpha > 0 else 1 - m).                                            (1)

What the text leaves open is a ``Reading``. Taken are: m in video values, the codes that the shader samples over 255,
for no camera's curve is mentioned; the three cases of the text above the printed shader's lerp, (1 - alpha) N.L +
alpha m, which gives 2 N.L - m at -1; and alpha as it is, for the remark of section 4.4 that several lights end as plain
blending is an observation, not a step of the shader. docs/paper.md says what the other readings give.

``directional``: (1) with the frame's linear luminance for m, and alpha times the directionality of the environment's
dominant light: where the light is ambient, or comes from rivals, it says nothing about bumps and ``flat`` remains.

``relief``: (1) with the multiplicative factor made relative. The raw intensity makes a light weak on a dark receiver
and shines on faces that are turned away from it; what the paper wants from m is its *pattern*. So m becomes the pixel's
luminance over that of its surroundings (a box of the frame's summed-area table) and multiplies N.L. A receiver without
structure has m = 1, and gives what ``flat`` gives, for every alpha. The inverse: a bump that tilts the surface by a
small angle along the physical light changes its shading to 1 + e; seen from the opposite side it is 1 - e = 2 - m, to
first order, which also keeps the mean over the surroundings. With it (1) is

    response = N.L (1 + alpha (m - 1)),                                                                            (2)

linear in alpha, so nothing jumps where alpha changes sign. Kd is the surroundings' luminance in the pixel's hue: the
receiver's reflectance if white paper were just below clipping.

``reflectance``: Kd is the receiver's own reflectance, from what the camera sees and what the environment sends there,

    rho = pi L / E_environment(normal),                                                                        (3)

which is (exactly) right for a Lambertian receiver, whatever its pattern. A prior of ``PRIOR_WEIGHT`` keeps (3) sane
where the environment is dark, and no reflectance exceeds 1; a clipped channel gives what its code says, a lower bound.
Shading by relief is in rho as well, as if it were paint. Moderate deviations e from the surroundings are taken for
relief (beyond ``RELIEF_LIMIT`` they are paint: print, other objects), as far as the environment has a direction, and
are turned to the virtual light:

    response = N.L (1 + alpha e) / (1 + e),   e = directionality * biweight(m - 1) * (m - 1).                  (4)

With *cells* (``kernels/receiver_cells.py``) (3) takes the part of the environment that boxes and balls let through, and
the irradiance by virtual light that lit proxies send to each other is added to the direct one:

    added += Kd / pi * E_bounced.                                                                                  (5)

Where the environment is ambient its light says nothing about bumps: alpha in (2), and in (1) for ``directional``, is
multiplied by the key light's directionality.

Edges. A light without size has shadows without penumbra. Where a neighbour sees another surface and one of the two is
lit, or something else hides lights from it, the pixel is traced again with n^2 samples and averaged, as ``shade`` does
along outlines; what the camera's pixel says of the receiver holds for all of them.

References:
    [DH04] DiVerdi, Hoellerer, "Combining Dynamic Physical and Virtual Illumination in Augmented Reality", 2004.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import warp as wp

from warp_ar.kernels.area_lights import make_area_count, make_area_sample
from warp_ar.kernels.cells import any_cell_above_zero, look_up_cells
from warp_ar.kernels.color import decode, luminance
from warp_ar.kernels.edges import EdgeLists, list_edge, listed_edges, sample_listed_edges
from warp_ar.kernels.emitters import add_emitters
from warp_ar.kernels.irradiance import sh_irradiance
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import MOST_REGISTERS, QUICK_TO_COMPILE, Rows, launch, launch_rows, slow_to_compile
from warp_ar.kernels.shadow import LightSample, has_penumbra, make_shadow, make_visible_share, sample_light, tile_turn
from warp_ar.kernels.structs import Emitter, FrameParams, KeyLight, Light, Picture, Probe, RayScene
from warp_ar.kernels.summed_area import box_mean, intensity
from warp_ar.kernels.visibility import (
    FAR,
    Hit,
    TraceConfig,
    check_edge_samples,
    inside_rect,
    make_sample_direction,
    make_trace,
    meets_probe,
    surface_key,
)

wp.set_module_options({"enable_backward": False})

METHODS = ("flat", "paper", "directional", "relief", "reflectance")
"""Cheapest first."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """How equation (1) takes what the paper's text leaves open; the defaults are the letter of the text."""

    values: Literal["video", "linear"] = "video"
    """Of the multiplicative factor: codes over 255 as the shader samples them, or linear luminance."""
    blend: Literal["text", "shader"] = "text"
    """The three cases of the text, or the printed shader's lerp, which differs where alpha is negative."""
    weighted: bool = False
    """Whether alpha is multiplied by the directionality of the environment's light (section 4.4)."""


READINGS: Mapping[str, Reading] = MappingProxyType(
    {
        "paper": Reading(),
        "directional": Reading("linear", weighted=True),
        "paper_linear": Reading("linear"),
        "paper_shader": Reading(blend="shader"),
        "paper_weighted": Reading(weighted=True),
    }
)
"""Ways to take equation (1), by name: the two methods, and readings that docs/paper.md compares with ``paper``."""

DEFAULT_REFLECTANCE = wp.constant(wp.float32(0.5))
"""Of a receiver that nothing is known about: the material of ``flat`` and ``paper``, the prior of ``reflectance``."""
PRIOR_WEIGHT = wp.constant(wp.float32(0.002 * math.pi))
"""Irradiance at which the prior counts as much as the frame: that of a white receiver at half a code of 255."""
RELIEF_LIMIT = wp.constant(wp.float32(0.6))
"""Relative deviation from the surroundings from which structure is paint, not relief."""
MAX_RELIEF = wp.constant(wp.float32(4.0))
"""Largest m: a glint of the receiver is no reason to add more than four times the light."""
SURROUNDINGS = 1.0 / 8.0
"""Side of the box of a pixel's surroundings, in frame heights: larger than a wire, smaller than a light's falloff."""
_HUE_FLOOR = wp.constant(wp.float32(0.01))  # linear; noise in dark pixels has no hue
_INV_PI = wp.constant(wp.float32(1.0 / math.pi))
_MASKED = 8
"""Lights whose shadows are told apart: one bit each, of what ``relight`` writes for ``smooth_edges``."""
_LIT = wp.constant(1 << _MASKED)
"""The bit that tells whether any light arrives; the number of the surface stands above it."""
_SURFACE = wp.constant(_MASKED + 1)
_NOTHING = wp.constant(-1 << (_MASKED + 1))
_BALL = wp.constant(-2 << (_MASKED + 1))


@dataclasses.dataclass(frozen=True)
class RelightConfig:
    """What is compiled into the kernel."""

    method: str
    """How the receiver responds: one of ``METHODS`` or ``READINGS``."""
    trace: TraceConfig
    """Kinds of shape in the scene."""
    irradiance: Literal["sh", "map"] = "sh"
    """Form of the environment's irradiance, for ``reflectance``."""
    probes: bool = False
    """Whether there are mirror balls, which hide the receiver and throw shadows of virtual light."""
    soft: bool = False
    """Whether lights with a radius cast soft shadows; those of mirror balls stay hard."""
    emitters: bool = False
    """Whether ``reflectance`` knows emitters of the environment by their places."""
    ambient_visibility: bool = False
    """Whether ``reflectance`` knows which part of the environment reaches a point."""
    bounced: bool = False
    """Whether light that lit proxies send to each other is known."""
    edge_samples: int = 1
    """Samples per pixel along the edges of shadows and of proxies: a square number; 1 leaves edges hard."""
    area_samples: int = 0
    """Samples of what emits, per point; ``area_lights.POINT_SAMPLES``: as lights at points; 0: nothing emits."""

    def general(self, *, soft: bool) -> RelightConfig:
        """For any scene in which as much is known of the receiver."""
        return dataclasses.replace(self, trace=self.trace.general(), soft=soft)

    def __post_init__(self) -> None:
        known = dict.fromkeys((*METHODS, *READINGS))
        if self.method not in known:
            raise ValueError(f"method: {self.method!r} is none of {', '.join(known)}")
        check_edge_samples(self.edge_samples)


@wp.func
def shader_response(n_dot_l: wp.float32, multiplicative: wp.float32, alpha: wp.float32) -> wp.float32:
    """The lerp of [DH04]'s fragment shader as printed; light is not taken away."""
    return wp.max((1.0 - alpha) * n_dot_l + alpha * multiplicative, 0.0)


@wp.func
def text_response(n_dot_l: wp.float32, intensity: wp.float32, alpha: wp.float32) -> wp.float32:
    """Equation (1), [DH04] section 4.2."""
    weight = wp.min(wp.abs(alpha), 1.0)
    multiplicative = wp.where(alpha > 0.0, intensity, 1.0 - intensity)
    return (1.0 - weight) * n_dot_l + weight * multiplicative


@wp.func
def relief_factor(m: wp.float32, alpha: wp.float32) -> wp.float32:
    """Factor on N.L in equation (2)."""
    return wp.max(1.0 + wp.clamp(alpha, -1.0, 1.0) * (wp.min(m, MAX_RELIEF) - 1.0), 0.0)


@wp.func
def turned_relief(m: wp.float32, alpha: wp.float32, directionality: wp.float32) -> wp.float32:
    """Factor on N.L in equation (4)."""
    deviation = wp.clamp((m - 1.0) / RELIEF_LIMIT, -1.0, 1.0)
    window = 1.0 - deviation * deviation
    e = directionality * window * window * deviation * RELIEF_LIMIT
    return (1.0 + alpha * e) / (1.0 + e)


@wp.func
def reflectance_of(radiance: wp.float32, irradiance: wp.float32) -> wp.float32:
    """Equation (3) with its prior, one channel; within 0..1 for whatever comes in."""
    rho = (wp.pi * radiance + PRIOR_WEIGHT * DEFAULT_REFLECTANCE) / (wp.max(irradiance, 0.0) + PRIOR_WEIGHT)
    if not rho > 0.0:  # NaN as well
        return 0.0
    return wp.min(rho, 1.0)


@wp.func
def surrounding_luminance(
    table: wp.array2d[wp.uint32], decode_table: wp.array[wp.vec3], row: wp.int32, col: wp.int32, size: wp.int32
) -> wp.float32:
    """Linear luminance of the mean code around a pixel; never 0. A mean of codes is not swayed by a few highlights."""
    code = box_mean(table, row, col, size)
    low = wp.min(wp.int32(code), 254)
    fraction = code - wp.float32(low)
    linear = (1.0 - fraction) * luminance(decode_table[low]) + fraction * luminance(decode_table[low + 1])
    return wp.max(linear, 1.0e-4)


@wp.struct
class ReceiverCells:
    """What ``kernels/receiver_cells.py`` found for cells of the frame, each with the surface that it lies on."""

    ambient_visibility: wp.array2d[wp.vec3]  # share of the environment that reaches a cell
    ambient_surface: wp.array2d[wp.int32]  # ``surface_key`` of the cell, -1 for none
    ambient_stride: wp.int32  # pixels per cell
    bounced: wp.array2d[wp.vec3]  # irradiance by virtual light that other proxies send there
    bounced_surface: wp.array2d[wp.int32]
    bounced_stride: wp.int32


@wp.struct
class Receiver:
    """The receiver and the environment that lights it; what a ``RelightConfig`` leaves out is empty."""

    picture: Picture
    table: wp.array2d[wp.uint32]  # the frame's summed-area table
    box: wp.int32  # side of a pixel's surroundings
    probes: wp.array[Probe]
    key_lights: wp.array[KeyLight]
    irradiance_sh: wp.array[wp.vec3]
    irradiance_map: wp.array2d[wp.vec3]
    emitters: wp.array[Emitter]
    cells: ReceiverCells


@wp.struct
class DirectLighting:
    """What virtual light does at a point of the receiver."""

    added: wp.vec3  # radiance
    visibility: wp.int32  # whether any light arrives, and which do not: see ``is_edge``


@wp.struct
class Matter:
    """What a point of the receiver is taken to be."""

    kd: wp.vec3  # reflectance
    m: wp.float32  # luminance over that of the surroundings, or the intensity itself
    key: wp.vec3  # unit, toward the environment's dominant light
    directionality: wp.float32


@functools.cache
def make_find_matter(config: RelightConfig) -> wp.Function:
    """``find_matter(scene, receiver, hit, row, col, mirror) -> Matter``; arguments as those of ``direct_lighting``."""
    method, reading = config.method, READINGS.get(config.method)

    @wp.func(module="unique")
    def find_matter(
        scene: RayScene, receiver: Receiver, hit: Hit, row: wp.int32, col: wp.int32, mirror: wp.vec3
    ) -> Matter:
        matter = Matter()
        matter.kd = wp.vec3(DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE)
        matter.m = 1.0
        radiance = decode(receiver.picture.decode_table, receiver.picture.frame[row, col])
        is_mirrored = mirror[0] > 0.0
        if is_mirrored:
            radiance = wp.cw_div(radiance, mirror)
        matter.key = receiver.key_lights[0].direction
        matter.directionality = receiver.key_lights[0].directionality
        if wp.static(reading is not None):
            if wp.static(reading is not None and reading.values == "video"):
                matter.m = wp.float32(intensity(receiver.picture.frame[row, col])) / 255.0
            else:
                matter.m = luminance(radiance)
        else:
            around = luminance(radiance)
            if not is_mirrored:
                around = surrounding_luminance(receiver.table, receiver.picture.decode_table, row, col, receiver.box)
                matter.m = luminance(radiance) / around
            if wp.static(method == "relief"):
                hue = radiance + wp.vec3(_HUE_FLOOR, _HUE_FLOOR, _HUE_FLOOR)
                matter.kd = wp.min(around / luminance(hue) * hue, wp.vec3(1.0, 1.0, 1.0))
            else:
                if wp.static(config.irradiance == "sh"):
                    distant = sh_irradiance(receiver.irradiance_sh, hit.normal)
                else:
                    distant = sample_latlong(receiver.irradiance_map, hit.normal)
                if wp.static(config.emitters):
                    distant = add_emitters(distant, receiver.emitters, hit.point, hit.normal)
                if wp.static(config.ambient_visibility):
                    if not is_mirrored:
                        cells = receiver.cells
                        key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
                        size = wp.vec2i(receiver.picture.frame.shape[0], receiver.picture.frame.shape[1])
                        visibility = cells.ambient_visibility
                        stride = cells.ambient_stride
                        left = look_up_cells(visibility, cells.ambient_surface, stride, key, size, row, col)
                        if left[3] > 0.0:
                            distant = wp.cw_mul(distant, wp.vec3(left[0], left[1], left[2]))
                matter.kd = wp.vec3(
                    reflectance_of(radiance[0], distant[0]),
                    reflectance_of(radiance[1], distant[1]),
                    reflectance_of(radiance[2], distant[2]),
                )
        return matter

    return find_matter


@functools.cache
def make_area_response(config: RelightConfig) -> wp.Function:
    """``area_response(scene, receiver, hit, matter, turn) -> vec3``: sum of E_v visible response over what emits."""
    method, reading = config.method, READINGS.get(config.method)
    is_lit = make_shadow(config.trace)
    area_count, area_sample = make_area_count(config.area_samples), make_area_sample(config.area_samples)

    @wp.func(module="unique")
    def area_response(scene: RayScene, receiver: Receiver, hit: Hit, matter: Matter, turn: wp.float32) -> wp.vec3:
        total = wp.vec3()
        count = area_count(scene)
        for k in range(count):
            area = area_sample(scene, hit.point, hit.normal, k, count, turn)
            n_dot_l = wp.max(wp.dot(hit.normal, area.wi), 0.0)
            if wp.max(area.irradiance_normal) <= 0.0 or wp.dot(hit.geometric_normal, area.wi) <= 0.0:
                continue
            light = LightSample()
            light.wi = area.wi
            light.distance = area.distance
            if not is_lit(scene, hit.point, hit.geometric_normal, hit.error, light):
                continue
            if wp.static(config.probes):
                if meets_probe(receiver.probes, hit.point, area.wi, area.distance):
                    continue
            response = n_dot_l
            if wp.static(method != "flat"):
                alpha = wp.dot(area.wi, matter.key)
                if wp.static(reading is not None):
                    if wp.static(reading is not None and reading.weighted):
                        alpha = alpha * matter.directionality
                    if wp.static(reading is not None and reading.blend == "shader"):
                        response = shader_response(n_dot_l, matter.m, alpha)
                    else:
                        response = text_response(n_dot_l, matter.m, alpha)
                elif wp.static(method == "relief"):
                    response = n_dot_l * relief_factor(matter.m, alpha * matter.directionality)
                else:
                    response = n_dot_l * turned_relief(matter.m, alpha, matter.directionality)
            total += response * area.irradiance_normal
        return total

    return area_response


@functools.cache
def make_direct_lighting(config: RelightConfig) -> wp.Function:
    """``direct_lighting(scene, lights, receiver, hit, row, col, mirror, turn) -> DirectLighting``: of virtual light.

    The pixel (row, col) shows the hit: straight where ``mirror`` is zero, else as a mirror ball of that reflectance has
    it, which says nothing about the hit's surroundings. ``turn`` is for ``visible_share``.
    """
    is_lit = make_shadow(config.trace)
    visible_share = make_visible_share(config.trace) if config.soft else None
    find_matter = make_find_matter(config)
    method, reading = config.method, READINGS.get(config.method)
    area_response = make_area_response(config) if config.area_samples > 0 else None

    @wp.func(module="unique")
    def direct_lighting(
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        hit: Hit,
        row: wp.int32,
        col: wp.int32,
        mirror: wp.vec3,
        turn: wp.float32,
    ) -> DirectLighting:
        result = DirectLighting()
        known = bool(False)  # what the receiver is, found only once some light falls here
        matter = Matter()
        matter.kd = wp.vec3(DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE)
        added = wp.vec3()
        for index in range(lights.shape[0]):
            light = sample_light(lights[index], hit.point)
            n_dot_l = wp.max(wp.dot(hit.normal, light.wi), 0.0)
            if wp.dot(hit.geometric_normal, light.wi) <= 0.0 or wp.max(light.irradiance_normal) <= 0.0:
                continue
            bit = 1 << (index % wp.static(_MASKED))
            visible = float(1.0)
            if wp.static(config.soft):
                visible = visible_share(scene, hit.point, hit.geometric_normal, hit.error, lights[index], light, turn)
                if visible <= 0.0:
                    if not has_penumbra(lights[index], light):
                        result.visibility |= bit
                    continue
            else:
                if not is_lit(scene, hit.point, hit.geometric_normal, hit.error, light):
                    result.visibility |= bit
                    continue
            if wp.static(config.probes):
                if meets_probe(receiver.probes, hit.point, light.wi, light.distance):
                    result.visibility |= bit
                    continue
            result.visibility |= _LIT
            response = n_dot_l
            if wp.static(method != "flat"):
                if not known:
                    known = True
                    matter = find_matter(scene, receiver, hit, row, col, mirror)
                alpha = wp.dot(light.wi, matter.key)
                if wp.static(reading is not None):
                    if wp.static(reading is not None and reading.weighted):
                        alpha = alpha * matter.directionality
                    if wp.static(reading is not None and reading.blend == "shader"):
                        response = shader_response(n_dot_l, matter.m, alpha)
                    else:
                        response = text_response(n_dot_l, matter.m, alpha)
                elif wp.static(method == "relief"):
                    response = n_dot_l * relief_factor(matter.m, alpha * matter.directionality)
                else:
                    response = n_dot_l * turned_relief(matter.m, alpha, matter.directionality)
            added += visible * response * light.irradiance_normal
        if wp.static(config.area_samples > 0):
            if scene.area_lights.shape[0] > 0:
                if wp.static(method != "flat"):
                    if not known:
                        known = True
                        matter = find_matter(scene, receiver, hit, row, col, mirror)
                by_areas = area_response(scene, receiver, hit, matter, turn)
                if wp.max(by_areas) > 0.0:
                    result.visibility |= _LIT
                    added += by_areas
        if wp.static(config.bounced):
            if mirror[0] <= 0.0:
                cells = receiver.cells
                key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
                size = wp.vec2i(receiver.picture.frame.shape[0], receiver.picture.frame.shape[1])
                stride = cells.bounced_stride
                bounced = look_up_cells(cells.bounced, cells.bounced_surface, stride, key, size, row, col)
                if bounced[0] + bounced[1] + bounced[2] > 0.0:
                    result.visibility |= _LIT
                    if not known:
                        matter = find_matter(scene, receiver, hit, row, col, mirror)
                    added += wp.vec3(bounced[0], bounced[1], bounced[2])
        result.added = wp.cw_mul(matter.kd, added) * _INV_PI
        return result

    return direct_lighting


@functools.cache
def make_relight_kernel(config: RelightConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    closest_proxy = make_trace(config.trace).closest_proxy
    direct_lighting = make_direct_lighting(config)

    @slow_to_compile
    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def relight_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        # Out:
        added_out: wp.array2d[wp.vec3],
        visibility_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        black = wp.vec3(0.0, 0.0, 0.0)
        added_out[i, j] = black
        if not inside_rect(i, j, params[0].light_rect):
            return
        if wp.static(config.edge_samples > 1):
            visibility_out[i, j] = _NOTHING
        if wp.static(config.bounced):
            if not inside_rect(i, j, params[0].direct_rect):
                cells = receiver.cells
                size = wp.vec2i(receiver.picture.rays.shape[0], receiver.picture.rays.shape[1])
                if not any_cell_above_zero(cells.bounced, cells.bounced_surface, cells.bounced_stride, size, i, j):
                    return
        ray = receiver.picture.rays[i, j]
        direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params[0].camera_position, direction, FAR)
        # A face that is seen from behind is not the surface that the camera sees.
        if hit.shape < 0 or wp.dot(hit.geometric_normal, direction) >= 0.0:
            return
        if wp.static(config.probes):
            if meets_probe(receiver.probes, params[0].camera_position, direction, hit.t):
                if wp.static(config.edge_samples > 1):
                    visibility_out[i, j] = _BALL
                return
        lit = direct_lighting(scene, lights, receiver, hit, i, j, black, tile_turn(i, j))
        added_out[i, j] = lit.added
        if wp.static(config.edge_samples > 1):
            surface = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
            visibility_out[i, j] = (surface << _SURFACE) | lit.visibility

    return relight_kernel


@wp.func
def is_edge(visibility: wp.array2d[wp.int32], rect: wp.vec4i, row: wp.int32, column: wp.int32) -> wp.bool:
    """Whether virtual light may change within a pixel, or between it and the next one.

    That is where something stands before a light without penumbra for one of them alone, or where they see different
    surfaces and any light arrives. Balls have light of their own, which ``mirror_ball`` adds.
    """
    here = visibility[row, column]
    if here == _BALL:
        return False
    for k in range(4):
        i = row + wp.where(k == 0, -1, 0) + wp.where(k == 1, 1, 0)
        j = column + wp.where(k == 2, -1, 0) + wp.where(k == 3, 1, 0)
        if inside_rect(i, j, rect):
            there = visibility[i, j]
            if there != here and there != _BALL:
                differs = here ^ there
                if (differs & (_LIT - 1)) != 0:
                    return True
                if (differs >> _SURFACE) != 0 and ((here | there) & _LIT) != 0:
                    return True
    return False


@functools.cache
def make_sample_lighting(config: RelightConfig) -> wp.Function:
    """``sample_lighting(params, scene, lights, receiver, row, col, sample) -> vec4``: a sample's light, and 1.

    Zero where it sees a ball: such a sample does not count.
    """
    closest_proxy = make_trace(config.trace).closest_proxy
    direct_lighting = make_direct_lighting(config)
    sample_direction = make_sample_direction(config.edge_samples)

    @wp.func(module="unique")
    def sample_lighting(
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        row: wp.int32,
        col: wp.int32,
        sample: wp.int32,
    ) -> wp.vec4:
        direction = sample_direction(params, receiver.picture.rays[row, col], sample)
        hit = closest_proxy(scene, params[0].camera_position, direction, FAR)
        if wp.static(config.probes):
            if meets_probe(receiver.probes, params[0].camera_position, direction, hit.t):
                return wp.vec4(0.0)
        if hit.shape < 0 or wp.dot(hit.geometric_normal, direction) >= 0.0:
            return wp.vec4(0.0, 0.0, 0.0, 1.0)
        lit = direct_lighting(scene, lights, receiver, hit, row, col, wp.vec3(), tile_turn(row, col))
        return wp.vec4(lit.added[0], lit.added[1], lit.added[2], 1.0)

    return sample_lighting


@functools.cache
def make_smooth_edges_kernel(config: RelightConfig, *, left: bool = False) -> wp.Kernel:
    """Kernel that samples edges in place; if ``left``, only where the list did not hold all."""
    sample_lighting = make_sample_lighting(config)

    @wp.kernel(
        module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS, module_options=QUICK_TO_COMPILE
    )
    def smooth_edges_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        visibility: wp.array2d[wp.int32],
        edge_count: wp.array[wp.int32],
        edges: wp.array[wp.vec2i],
        # Out:
        added_out: wp.array2d[wp.vec3],
    ):
        i, j = wp.tid()
        i += row_start
        if wp.static(left):
            if edge_count[0] <= edges.shape[0]:
                return
        rect = params[0].light_rect
        if not inside_rect(i, j, rect):
            return
        if not is_edge(visibility, rect, i, j):
            return
        total = wp.vec4()
        count = wp.int32(wp.static(config.edge_samples))  # a variable: the loop must not be unrolled
        for sample in range(count):
            total += sample_lighting(params, scene, lights, receiver, i, j, sample)
        if total[3] > 0.0:
            added_out[i, j] = wp.vec3(total[0], total[1], total[2]) / total[3]

    return smooth_edges_kernel


@wp.kernel(enable_backward=False)
def list_edges_kernel(
    # In:
    params: wp.array[FrameParams],
    visibility: wp.array2d[wp.int32],
    # Out:
    edge_count_out: wp.array[wp.int32],
    edges_out: wp.array[wp.vec2i],
):
    """List the pixels that ``is_edge`` finds."""
    i, j = wp.tid()
    rect = params[0].light_rect
    if inside_rect(i, j, rect):
        if is_edge(visibility, rect, i, j):
            list_edge(i, j, edge_count_out, edges_out)


@functools.cache
def make_sample_edges_kernel(config: RelightConfig) -> wp.Kernel:
    """Kernel that takes every sample of the edges that were listed."""
    sample_lighting = make_sample_lighting(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def sample_lighting_edges_kernel(
        # In:
        threads: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        edge_count: wp.array[wp.int32],
        edges: wp.array[wp.vec2i],
        # Out:
        samples_out: wp.array[wp.vec4],
    ):
        item = wp.tid()
        stop = listed_edges(edge_count, edges) * wp.static(config.edge_samples)
        while item < stop:
            edge = edges[item / wp.static(config.edge_samples)]
            sample = item % wp.static(config.edge_samples)
            samples_out[item] = sample_lighting(params, scene, lights, receiver, edge[0], edge[1], sample)
            item += threads

    return sample_lighting_edges_kernel


def surroundings_size(height: int) -> int:
    """Side of the box of a pixel's surroundings in a frame of ``height`` rows, odd."""
    return 2 * round(0.5 * SURROUNDINGS * height) + 1


def make_receiver(
    config: RelightConfig,
    picture: Picture,
    *,
    table: wp.array | None = None,
    probes: wp.array | None = None,
    key_lights: wp.array | None = None,
    irradiance: wp.array | None = None,
    emitters: wp.array | None = None,
    cells: ReceiverCells | None = None,
) -> Receiver:
    """What kernels read of the receiver; what the method leaves out may be None.

    Args:
        config: Method and forms of light.
        picture: (H, W) the camera's.
        table: (H, W) uint32, the frame's summed-area table; needed by ``relief`` and ``reflectance``.
        probes: (p,) Probe; needed if ``config.probes``.
        key_lights: (k,) KeyLight, brightest first; needed by all methods but ``flat``.
        irradiance: Irradiance of the environment, nine coefficients or a latlong map as ``config.irradiance`` says;
            needed by ``reflectance``.
        emitters: (q,) Emitter, seen from the first probe; needed if ``config.emitters``.
        cells: From ``receiver_cells``; needed if ``config.ambient_visibility`` or ``config.bounced``.
    """
    receiver = Receiver()
    receiver.picture, receiver.box = picture, surroundings_size(picture.rays.shape[0])
    form = f"irradiance_{config.irradiance}"
    optional = {"table": table, "probes": probes, "key_lights": key_lights, form: irradiance, "emitters": emitters}
    for name, value in {**optional, "cells": cells}.items():
        if value is not None:
            setattr(receiver, name, value)
    return receiver


def relight(
    config: RelightConfig,
    params: wp.array[FrameParams],
    scene: RayScene,
    lights: wp.array[Light],
    receiver: Receiver,
    added_out: wp.array2d[wp.vec3],
    visibility_out: wp.array2d[wp.int32] | None = None,
    *,
    rows: Rows | None = None,
) -> None:
    """Write the radiance that virtual lights add to the receiver; zero outside ``params[0].light_rect``.

    One sample per pixel: where ``config.edge_samples`` is more than 1, ``smooth_edges`` comes next.

    Args:
        config: Method and kinds of shape.
        params: (1,) FrameParams: camera, light_rect and, if ``config.bounced``, direct_rect.
        scene: Objects and proxies.
        lights: (n,) Light.
        receiver: Of ``make_receiver``.
        added_out: (H, W) linear radiance in camera values.
        visibility_out: (H, W) which surface a pixel sees and which lights do not; needed if ``config.edge_samples`` is
            more than 1. Only what lies in ``light_rect`` is written.
        rows: Band of rows; None means all.
    """
    rays = receiver.picture.rays
    launch_rows(
        make_relight_kernel(config),
        rays.shape,
        [params, scene, lights, receiver],
        [added_out, visibility_out],
        rows=rows,
        device=rays.device,
    )


def smooth_edges(
    config: RelightConfig,
    params: wp.array[FrameParams],
    scene: RayScene,
    lights: wp.array[Light],
    receiver: Receiver,
    visibility: wp.array2d[wp.int32],
    added_out: wp.array2d[wp.vec3],
    *,
    edge_lists: EdgeLists | None = None,
    rows: Rows | None = None,
) -> None:
    """Average ``config.edge_samples`` samples in pixels along the edges of shadows and of lit proxies.

    Args:
        config: As that of ``relight``, and so are all arguments that are not named here.
        params: Likewise.
        scene: Likewise.
        lights: Likewise.
        receiver: Likewise.
        visibility: (H, W) as ``relight`` writes.
        added_out: (H, W) as ``relight`` writes; changed along edges.
        edge_lists: Scratch, for a launch over all rows: edges are then sampled on their own.
        rows: Band of rows; None means all.
    """
    shape, device = receiver.picture.rays.shape, receiver.picture.rays.device
    inputs = [params, scene, lights, receiver]
    if edge_lists is None:
        kernel = make_smooth_edges_kernel(config)
        launch_rows(kernel, shape, [*inputs, visibility, None, None], [added_out], rows=rows, device=device)
        return
    listed = [edge_lists.count, edge_lists.edges]
    edge_lists.count.zero_()
    launch(list_edges_kernel, shape, [params, visibility], listed, device=device)
    kernel = make_smooth_edges_kernel(config, left=True)
    launch_rows(kernel, shape, [*inputs, visibility, *listed], [added_out], rows=None, device=device)
    sample_listed_edges(
        make_sample_edges_kernel(config), inputs, edge_lists, config.edge_samples, added_out, weighted=True
    )
