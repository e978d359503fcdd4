"""A camera above the desk, the cells of its surfaces, and all that their launchers ask for."""

import dataclasses

import numpy as np
import warp as wp

from tests.kernel_rig import constant_environment, records, shape, tables, trace_of
from tests.relight_rig import CAMERA, DESK, LOOK_DOWN, point
from tests.twins import receiver_cells as reference
from warp_ar.kernels.cells import SurfaceCells
from warp_ar.kernels.receiver import receiver_cells, relight
from warp_ar.kernels.receiver.receiver import ReceiverCells, RelightConfig, make_receiver
from warp_ar.kernels.receiver.receiver_cells import Patch
from warp_ar.kernels.structs import (
    BOX,
    MESH,
    PLANE,
    FrameParams,
    KeyLight,
    Light,
    Material,
    Probe,
    RayScene,
    Shape,
    filled,
    make_picture,
)

SIZE_OF_FRAME = (48, 64)
FOCAL = 60.0
GREY = reference.GREY
# Sums of float32 over up to 32,768 samples of like size.
SUM_ERROR = 2e-4
# A texel of the sky at a shape's outline is hidden or not: one row of 64 over the height of a wall or ball.
OUTLINE = 0.006
# A patch is one sample of its area, softened by A / pi over r^2: patches of 1 cm from 10 cm on.
PATCHES = 5e-3
ABOVE = point((0, 0, 0.5))
"""Shines on all of the desk."""
WHITE = np.ones(3)


def box(low, high):
    low, high = np.asarray(low, float), np.asarray(high, float)
    return shape(BOX, tuple((low + high) / 2), tuple((high - low) / 2))


def ball(center, radius, reflectance=0.85):
    return {"center": center, "radius": radius, "reflectance": (reflectance,) * 3}


def pixel_rays(size):
    rows, columns = ((np.arange(n) - (n - 1) / 2) / FOCAL for n in size)
    return np.stack(np.meshgrid(columns, rows), -1).astype(np.float32)


class View:
    """A camera above the desk, and all that the launchers ask for."""

    def __init__(
        self,
        proxies=(DESK,),
        probes=(),
        lights=(ABOVE,),
        size=SIZE_OF_FRAME,
        rect=None,
        surroundings=WHITE,
        frame=None,
        camera=CAMERA,
        turn=LOOK_DOWN,
        irradiance=None,
        scene=None,
        others=None,
        sees_boxes=False,
        objects=(),
        materials=(),
        **forms,
    ):
        """``sees_boxes``: what stands on the desk is in the frame; else the lens's axis passes far from it."""
        forms = {**forms, "several": others is not None}
        self.others = others
        trace = trace_of(objects, proxies if scene is None else [{"kind": kind} for kind in (BOX, PLANE, MESH)])
        self.relight = RelightConfig("reflectance", trace, "sh" if irradiance is None else "map", **forms)
        self.config = self.relight
        self.size = size
        self.params = records(
            FrameParams,
            {
                "camera_position": camera,
                "world_from_camera": turn,
                "focal": (FOCAL, FOCAL),
                "principal": ((size[1] - 1) / 2, (size[0] - 1) / 2) if sees_boxes else (-1e5, -1e5),
                "light_rect": rect or (0, size[0], 0, size[1]),
                "direct_rect": rect or (0, size[0], 0, size[1]),
            },
        )
        self.rays = wp.array(pixel_rays(size), dtype=wp.vec2)
        self.scene = RayScene() if scene is None else scene
        if scene is None:
            self.scene.objects, self.scene.proxies = records(Shape, *objects), records(Shape, *proxies)
            self.scene.materials = records(Material, *materials)
        self.lights = records(Light, *lights)
        image = np.full((*size, 3), 128, np.uint8) if frame is None else frame
        self.frame = wp.array(image, dtype=wp.vec3ub)
        self.keys = records(KeyLight, {"direction": (0, 0, 1), "directionality": 0.0})
        self.probes = records(Probe, *probes)
        self.surroundings = wp.array(constant_environment(surroundings), dtype=wp.vec3)
        if irradiance is not None:
            self.surroundings = wp.array(irradiance, dtype=wp.vec3)

    def receiver(self, cells=None):
        return make_receiver(
            self.relight,
            make_picture(self.frame, tables()[0], self.rays),
            probes=self.probes,
            key_lights=self.keys,
            irradiance=self.surroundings,
            others=self.others,
            cells=cells,
        )

    def cells(self, stride):
        return tuple(-(-n // stride) for n in self.size)

    def share(self, samples, stride=4, count=None, rows=None, out=None, cells=None, bounced=False, threads=1):
        share = wp.full(self.cells(stride), wp.vec3(7.0, 7.0, 7.0), dtype=wp.vec3) if out is None else out[0]
        surface = wp.full(self.cells(stride), 7, dtype=wp.int32) if out is None else out[1]
        written = filled(SurfaceCells(), values=share, surface=surface, stride=stride)
        parts = wp.empty((*self.cells(stride), threads), dtype=receiver_cells.LightPart)
        inputs = self.params, self.scene, self.lights, self.receiver(cells), samples[:count]
        receiver_cells.sum_ambient_light(self.config, *inputs, bounced, written, parts, rows=rows)
        receiver_cells.find_ambient_visibility(parts, bounced, written, rows=rows)
        return share.numpy(), surface.numpy()

    def send(self, stride=4, rows=None, out=None, cells=None):
        patches = wp.full(self.cells(stride), Patch(), dtype=Patch) if out is None else out
        receiver_cells.send_light(
            self.config, self.params, self.scene, self.lights, self.receiver(cells), stride, patches, rows=rows
        )
        return patches

    def gather(self, patches, patch_stride=4, stride=4, rows=None, out=None):
        listed, count = wp.full(patches.shape, Patch(), dtype=Patch), wp.full(patches.shape[0], 99, dtype=wp.int32)
        for band in rows or [None]:
            receiver_cells.list_patches(patches, listed, count, rows=band and (band[0] // 2, band[1] // 2))
        if rows:
            receiver_cells.list_patches(patches, listed, count, rows=(rows[-1][1] // 2, patches.shape[0]))
        bounced = wp.full(self.cells(stride), wp.vec3(7.0, 7.0, 7.0), dtype=wp.vec3) if out is None else out[0]
        surface = wp.full(self.cells(stride), 7, dtype=wp.int32) if out is None else out[1]
        written = filled(SurfaceCells(), values=bounced, surface=surface, stride=stride)
        inputs = self.config, self.params, self.scene, self.receiver(), listed, count, patch_stride
        for band in rows or [None]:
            receiver_cells.gather_light(*inputs, written, rows=band)
        return bounced.numpy(), surface.numpy()

    def light(self, cells=None, rows=None, **forms):
        out = wp.full(self.size, wp.vec3(9.0, 9.0, 9.0), dtype=wp.vec3)
        config = dataclasses.replace(self.relight, **forms)
        relight.relight(config, self.params, self.scene, self.lights, self.receiver(cells), out, None, rows=rows)
        return out.numpy()


def patches_of(positions, normals, radiance, areas):
    """One row of patches."""
    positions = np.atleast_2d(positions)
    out = np.zeros((1, len(positions)), np.dtype(Patch.numpy_dtype()))
    out["position"], out["normal"], out["area"] = positions, normals, areas
    out["flux"] = np.asarray(radiance, float) * np.reshape(areas, (-1, 1))
    return wp.array(out, dtype=Patch)


def middles(stride, size=SIZE_OF_FRAME):
    return np.ix_(*(np.minimum(np.arange(-(-n // stride)) * stride + stride // 2, n - 1) for n in size))


def cells_of(view, stride, share=None, share_surface=None, bounced=None, bounced_surface=None):
    cells = {}
    for name, values, surface in (("ambient", share, share_surface), ("bounced", bounced, bounced_surface)):
        if values is not None:
            values = np.broadcast_to(np.asarray(values, np.float32), (*view.cells(stride), 3)).copy()
            values = wp.array(values, dtype=wp.vec3)
        surface = np.zeros(view.cells(stride), np.int32) if surface is None else surface
        surface = wp.array(surface, dtype=wp.int32)
        cells[name] = filled(SurfaceCells(), values=values, surface=surface, stride=stride)
    return filled(ReceiverCells(), **cells)
