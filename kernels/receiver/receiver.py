"""The receiver (a physical surface that virtual light reaches): its material and its response to that light.

A light of irradiance E_v (facing it) that arrives along wi adds to a pixel's radiance

    added = Kd / pi * E_v * response.

Methods differ in Kd and in the response, with N.L = max(normal . wi, 0):

========================  =========================================================  =============================
method                    Kd                                                         response
========================  =========================================================  =============================
``flat``                  a grey constant                                            N.L
``paper``                 a grey constant                                            (1), the letter of [DH04]
``reflectance``           radiance in the frame over the environment's irradiance, (2)  N.L
========================  =========================================================  =============================

``flat`` equals plain alpha blending of a lit proxy. Each equation stands above its function. ``make_find_matter`` finds
the material of a point, ``make_respond`` its response; ``kernels/receiver/relight.py`` sums over lights.

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

from warp_ar.kernels.cells import SurfaceCells, look_up_cells
from warp_ar.kernels.color import luminance
from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls, make_irradiance_at
from warp_ar.kernels.picture.summed_area import intensity
from warp_ar.kernels.pixels import cut_luma, shown_radiance
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.rays.visibility import check_edge_samples
from warp_ar.kernels.structs import Emitter, Hit, KeyLight, Picture, Probe, filled

wp.set_module_options({"enable_backward": False})

METHODS = ("flat", "paper", "reflectance")
"""Cheapest first."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """Choices of equation (1) that the paper's text leaves open; the defaults are the letter of the text."""

    values: Literal["video", "linear"] = "video"
    """Values of the multiplicative factor: codes over 255 as in the paper's shader, or linear luminance."""
    blend: Literal["text", "shader"] = "text"
    """The three cases of the text, or the printed shader's lerp, which differs where alpha is negative."""
    weighted: bool = False
    """True if alpha is multiplied by the directionality of the environment's light (section 4.4)."""


READINGS: Mapping[str, Reading] = MappingProxyType(
    {
        "paper": Reading(),
        "paper_linear": Reading("linear"),
        "paper_shader": Reading(blend="shader"),
        "paper_weighted": Reading(weighted=True),
    }
)
"""Readings of equation (1), by name: that of the method ``paper``, and those that docs/paper.md compares with it."""
DEFAULT_REFLECTANCE = wp.constant(wp.float32(0.5))
"""Reflectance of an unknown receiver: the material of ``flat`` and ``paper``, the prior of ``reflectance``."""
PRIOR_WEIGHT = wp.constant(wp.float32(0.002 * math.pi))
"""Irradiance at which the prior counts as much as the frame: that of a white receiver at half a code of 255."""


@dataclasses.dataclass(frozen=True)
class RelightConfig:
    """Compile-time configuration of the kernel."""

    method: str
    """Response of the receiver: one of ``METHODS`` or ``READINGS``."""
    trace: TraceConfig
    """Kinds of shape in the scene."""
    irradiance: Literal["sh", "map"] = "sh"
    """Form of the environment's irradiance, for ``reflectance``: spherical harmonics or a latlong map."""
    soft: bool = False
    """True if lights with a radius cast soft shadows; shadows of mirror balls stay hard."""
    emitters: bool = False
    """True if ``reflectance`` uses the positions of the environment's emitters."""
    ambient_visibility: bool = False
    """True if ``reflectance`` reduces the irradiance to the share of the environment that is not hidden."""
    bounced: bool = False
    """True if light that lit proxies send to each other is added."""
    edge_samples: int = 1
    """Samples per pixel along the edges of shadows and of proxies: a square number; 1 leaves edges hard."""
    several: bool = False
    """True if the light of several mirror balls is interpolated."""
    area_samples: int = 0
    """Samples of emitting objects per point; ``area_lights.POINT_SAMPLES``: they are point lights; 0: none emits."""
    area_cells: bool = False
    """True if light of emitting objects is estimated per cell; False if it is estimated at each pixel."""

    def general(self, *, soft: bool) -> RelightConfig:
        """Return this configuration with code for every kind of shape, and for soft shadows if ``soft``."""
        return dataclasses.replace(self, trace=self.trace.general(), soft=soft)

    def __post_init__(self) -> None:
        known = dict.fromkeys((*METHODS, *READINGS))
        if self.method not in known:
            raise ValueError(f"method: {self.method!r} is none of {', '.join(known)}")
        check_edge_samples(self.edge_samples)


@wp.func
def shader_response(n_dot_l: wp.float32, multiplicative: wp.float32, alpha: wp.float32) -> wp.float32:
    """Return the response by the linear interpolation of the shader printed in [DH04], at least 0."""
    return wp.max((1.0 - alpha) * n_dot_l + alpha * multiplicative, 0.0)


# Equation (1). [DH04] section 4.2: the *additive factor* is N.L, the *multiplicative factor* m the intensity of the
# video, and alpha "the dot product of the virtual light vector and the brightest physical lighting vector". "When the
# dot product is close to one, most of the contribution is from the multiplicative factor, when it is close to zero, the
# contribution is from the additive factor, and when it is negative one, the inverse of the multiplicative factor is
# used":
#
#     response = (1 - |alpha|) N.L + |alpha| (m if alpha > 0 else 1 - m).                                          (1)
#
# A ``Reading`` settles what the text leaves open. ``paper`` takes m in video values, the shader's codes over 255,
# because the paper mentions no camera curve. It prefers the three cases of the text to the printed shader's lerp,
# (1 - alpha) N.L + alpha m, which gives 2 N.L - m at -1. It does not scale alpha: section 4.4 observes that several
# lights end as plain blending, but names no step of the shader. docs/paper.md compares the other readings.
@wp.func
def text_response(n_dot_l: wp.float32, intensity: wp.float32, alpha: wp.float32) -> wp.float32:
    """Return the response by equation (1), [DH04] section 4.2; ``intensity`` is the multiplicative factor m."""
    weight = wp.min(wp.abs(alpha), 1.0)
    multiplicative = wp.where(alpha > 0.0, intensity, 1.0 - intensity)
    return (1.0 - weight) * n_dot_l + weight * multiplicative


# Equation (2). The receiver's reflectance, from the radiance L in the frame and the environment's irradiance E there,
#
#     rho = pi L / E_environment(normal),                                                                          (2)
#
# which is exact for a Lambertian receiver with any pattern. A prior of ``PRIOR_WEIGHT`` bounds (2) where the
# environment is dark, and no reflectance exceeds 1. A clipped channel gives a lower bound. With *cells*
# (``receiver_cells.py``) E is the light of the environment that boxes and balls do not hide. Shading that the proxy
# does not model (relief, clutter) is taken for a darker reflectance.
@wp.func
def reflectance_of(radiance: wp.float32, irradiance: wp.float32) -> wp.float32:
    """Return the reflectance of equation (2) with its prior, for one channel; within 0..1 for any input."""
    rho = (wp.pi * radiance + PRIOR_WEIGHT * DEFAULT_REFLECTANCE) / (wp.max(irradiance, 0.0) + PRIOR_WEIGHT)
    if not rho > 0.0:  # NaN as well
        return 0.0
    return wp.min(rho, 1.0)


@wp.struct
class ReceiverCells:
    """Light and visibility per cell (a block of pixels) of the receiver, computed by ``receiver_cells.py``."""

    ambient: SurfaceCells  # share of the environment that reaches a cell
    bounced: SurfaceCells  # irradiance of virtual light that other proxies reflect to a cell
    area: SurfaceCells  # irradiance of emitting objects


@wp.struct
class Receiver:
    """The receiver and the environment that lights it. Arrays that a ``RelightConfig`` does not use are empty."""

    picture: Picture
    probes: wp.array[Probe]
    key_lights: wp.array[KeyLight]
    irradiance_sh: wp.array[wp.vec3]
    irradiance_map: wp.array2d[wp.vec3]
    emitters: wp.array[Emitter]
    others: OtherBalls
    cells: ReceiverCells


@wp.func
def frame_size(receiver: Receiver) -> wp.vec2i:
    """Return (rows, columns) of the frame."""
    return wp.vec2i(receiver.picture.rays.shape[0], receiver.picture.rays.shape[1])


@wp.struct
class Matter:
    """Material of a point of the receiver."""

    kd: wp.vec3  # reflectance
    m: wp.float32  # the multiplicative factor: intensity of the video
    key: wp.vec3  # unit, toward the environment's dominant light
    directionality: wp.float32


@functools.cache
def make_find_matter(config: RelightConfig) -> wp.Function:
    """Return ``find_matter(receiver, hit, key, row, col, mirror) -> Matter``: material of a point of the receiver.

    ``key`` is the hit's ``surface_key``. The pixel (row, col) shows the hit directly if ``mirror`` is zero, else
    reflected in a ball of reflectance ``mirror``.
    """
    method, reading = config.method, READINGS.get(config.method)
    irradiance_at = make_irradiance_at(config.irradiance, config.emitters, config.several)

    @wp.func(module="unique")
    def find_matter(
        receiver: Receiver, hit: Hit, key: wp.int32, row: wp.int32, col: wp.int32, mirror: wp.vec3
    ) -> Matter:
        matter = Matter()
        matter.kd = wp.vec3(DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE)
        matter.m = 1.0
        radiance = wp.max(shown_radiance(receiver.picture, row, col), wp.vec3(0.0, 0.0, 0.0))
        # Light above white counts as white where it is compared with codes.
        coded = wp.min(radiance, receiver.picture.decode_table[255])
        is_mirrored = mirror[0] > 0.0
        if is_mirrored:
            coded = wp.cw_div(coded, mirror)
            radiance = wp.cw_div(radiance, mirror)
        if wp.static(method == "reflectance"):
            distant = irradiance_at(
                receiver.irradiance_sh,
                receiver.irradiance_map,
                receiver.emitters,
                receiver.others,
                hit.point,
                hit.normal,
            )
            if wp.static(config.ambient_visibility):
                if not is_mirrored:
                    left = look_up_cells(receiver.cells.ambient, key, frame_size(receiver), row, col)
                    if left[3] > 0.0:
                        distant = wp.cw_mul(distant, wp.vec3(left[0], left[1], left[2]))
            matter.kd = wp.vec3(
                reflectance_of(radiance[0], distant[0]),
                reflectance_of(radiance[1], distant[1]),
                reflectance_of(radiance[2], distant[2]),
            )
        else:
            matter.key = receiver.key_lights[0].direction
            matter.directionality = receiver.key_lights[0].directionality
            if wp.static(reading is not None and reading.values == "video"):
                seen = receiver.picture
                cut = cut_luma(seen.frame, seen.decode_table, seen.linear, row, col)
                matter.m = wp.clamp((wp.float32(intensity(seen.frame[row, col])) + cut) / 255.0, 0.0, 1.0)
            else:
                matter.m = luminance(coded)
        return matter

    return find_matter


@functools.cache
def make_respond(method: str) -> wp.Function:
    """Return ``respond(matter, wi, n_dot_l) -> float32``: a point's response, by one of ``METHODS`` or ``READINGS``.

    It applies to virtual lights and to samples of emitting objects alike. ``flat`` does not read ``matter``.
    """
    reading = READINGS.get(method)

    @wp.func(module="unique")
    def respond(matter: Matter, wi: wp.vec3, n_dot_l: wp.float32) -> wp.float32:
        response = n_dot_l
        if wp.static(reading is not None):
            alpha = wp.dot(wi, matter.key)
            if wp.static(reading is not None and reading.weighted):
                alpha = alpha * matter.directionality
            if wp.static(reading is not None and reading.blend == "shader"):
                response = shader_response(n_dot_l, matter.m, alpha)
            else:
                response = text_response(n_dot_l, matter.m, alpha)
        return response

    return respond


def make_receiver(
    config: RelightConfig,
    picture: Picture,
    *,
    probes: wp.array | None = None,
    key_lights: wp.array | None = None,
    irradiance: wp.array | None = None,
    emitters: wp.array | None = None,
    others: OtherBalls | None = None,
    cells: ReceiverCells | None = None,
) -> Receiver:
    """Return the ``Receiver`` of these arrays. Arguments that the method does not use may be None.

    Args:
        config: Method and forms of light.
        picture: (H, W) the camera's frame and rays.
        probes: (p,) Probe, mirror balls, which hide the receiver and throw shadows of virtual light.
        key_lights: (k,) KeyLight, brightest first; needed by the paper's blend.
        irradiance: Irradiance of the environment, nine coefficients or a latlong map as ``config.irradiance`` says;
            needed by ``reflectance``.
        emitters: (q,) Emitter, seen from the first probe; needed if ``config.emitters``.
        others: The balls after the first; needed if ``config.several``.
        cells: From ``receiver_cells``; needed if the config names any.
    """
    given = {"probes": probes, "key_lights": key_lights, f"irradiance_{config.irradiance}": irradiance}
    return filled(Receiver(), picture=picture, emitters=emitters, others=others, cells=cells, **given)
