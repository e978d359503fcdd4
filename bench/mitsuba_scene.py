"""A scene file as Mitsuba has it, lit by the same map: another renderer for what the path tracer says.

Objects, proxies, balls, virtual lights, camera and materials are those of the scene; proxies are matt, of one colour
each. Materials are the formulas of ``kernels/materials.py`` written a second time, in Mitsuba's own numbers; only the
table of directional albedo is shared. Not handled: textures, materials that meshes' files bring, lights of directions,
sizes of lights other than points, attenuation other than the inverse square.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.errors import UsageError
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.scene import (
    Camera,
    LambertMaterial,
    Light,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Pose,
    Proxy,
    Scene,
)
from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.object_materials import file_mesh
from warp_ar.scene.shapes import silhouette_tolerance, torus_mesh

DFG_SIZE = 32
MIN_ALPHA = 1.0e-3
DIELECTRIC_F0 = 0.04

Dict = dict[str, Any]
Float = npt.NDArray[np.float32]


def rgb(values: Any) -> Dict:
    """A colour."""
    return {"type": "rgb", "value": [float(v) for v in values]}


def matt(values: Any) -> Dict:
    """A matt surface, seen from both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(values)}}


def mirror(values: Any) -> Dict:
    """A mirror, the same at every angle."""
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb(values)}


@functools.cache
def _dfg() -> Float:
    table = wp.zeros((DFG_SIZE, DFG_SIZE), dtype=wp.vec2, device="cpu")
    integrate_dfg(table)
    return np.asarray(table.numpy(), np.float32)


@functools.cache
def register_glossy() -> str:
    """Name of a BSDF that is the renderer's metallic-roughness or Phong, a cosine lobe and a diffuse part."""

    class Glossy(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.base = mi.Color3f(props["base"])
            self.metallic, self.roughness = float(props["metallic"]), float(props["roughness"])
            self.alpha = max(self.roughness**2, MIN_ALPHA)
            self.shininess = float(props["shininess"])  # below 0: metallic-roughness
            self.specular = mi.Color3f(props["specular"])
            row = self.roughness * (DFG_SIZE - 1)
            low = min(int(row), DFG_SIZE - 2)
            line = _dfg()[low] * (1.0 - row + low) + _dfg()[low + 1] * (row - low)
            self.scale, self.bias = (mi.Float(np.ascontiguousarray(line[:, c])) for c in (0, 1))
            flags = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection
            self.m_components = [flag | mi.BSDFFlags.FrontSide for flag in flags]
            self.m_flags = self.m_components[0] | self.m_components[1]
            self.microfacets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, True)

        def albedo(self, cosine: Any) -> tuple[Any, Any]:
            place = dr.clip(cosine, 0, 1) * (DFG_SIZE - 1)
            low = dr.minimum(mi.UInt32(place), DFG_SIZE - 2)
            share = place - low
            return tuple(
                dr.lerp(dr.gather(mi.Float, table, low), dr.gather(mi.Float, table, low + 1), share)
                for table in (self.scale, self.bias)
            )  # type: ignore[return-value]

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            cos_i, cos_o = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi)
            active &= (cos_i > 0) & (cos_o > 0)
            if self.shininess >= 0.0:
                power = dr.power(dr.maximum(dr.dot(mi.reflect(si.wi), wo), 0), self.shininess)
                value = self.base * cos_i / dr.pi + self.specular * (self.shininess + 1) / (2 * dr.pi) * power
                return dr.select(active, value, 0)
            scale, bias = self.albedo(cos_o)
            once = dr.clip(scale + bias, 1e-3, 1)
            later = dr.sqrt(once)

            def gain(f: Any) -> Any:
                return 1 + f * (1 / once - 1) * later / (1 - f * (1 - later))

            plastic_gain, metal_gain = gain(DIELECTRIC_F0), gain(self.base)
            f0 = DIELECTRIC_F0 * (1 - self.metallic) * plastic_gain + self.metallic * self.base * metal_gain
            f90 = (1 - self.metallic) * plastic_gain + self.metallic * metal_gain
            plastic = (DIELECTRIC_F0 * scale + bias) * plastic_gain
            half = dr.normalize(wo + si.wi)
            fresnel = f0 + dr.power(dr.clip(1 - dr.dot(si.wi, half), 0, 1), 5) * (f90 - f0)
            square = self.alpha * self.alpha
            cos_h = mi.Frame3f.cos_theta(half)
            lobe = square / (dr.pi * dr.square(cos_h * cos_h * (square - 1) + 1))
            smith = cos_i * dr.sqrt(cos_o * cos_o * (1 - square) + square)
            smith += cos_o * dr.sqrt(cos_i * cos_i * (1 - square) + square)
            glossy = cos_i * lobe * 0.5 / smith * fresnel
            diffuse = (1 - self.metallic) * self.base * (1 - plastic) * cos_i / dr.pi
            return dr.select(active, glossy + diffuse, 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            cos_i, cos_o = mi.Frame3f.cos_theta(wo), mi.Frame3f.cos_theta(si.wi)
            active &= (cos_i > 0) & (cos_o > 0)
            cosine = mi.warp.square_to_cosine_hemisphere_pdf(wo)
            if self.shininess >= 0.0:
                power = dr.power(dr.maximum(dr.dot(mi.reflect(si.wi), wo), 0), self.shininess)
                lobe = (self.shininess + 1) / (2 * dr.pi) * power
            else:
                half = dr.normalize(wo + si.wi)
                lobe = self.microfacets.pdf(si.wi, half) / (4 * dr.maximum(dr.dot(wo, half), 1e-7))
            return dr.select(active, 0.5 * (lobe + cosine), 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            scattered = mi.warp.square_to_cosine_hemisphere(sample2)
            if self.shininess >= 0.0:
                cosine = dr.power(sample2.x, 1 / (self.shininess + 1))
                sine, turn = dr.safe_sqrt(1 - cosine * cosine), 2 * dr.pi * sample2.y
                around = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), cosine)
                mirrored = mi.Frame3f(mi.reflect(si.wi)).to_world(around)
            else:
                half, _ = self.microfacets.sample(si.wi, sample2)
                mirrored = mi.reflect(si.wi, half)
            glossy = sample1 < 0.5
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(glossy, mirrored, scattered)
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            kinds = (mi.UInt32(+flag) for flag in (mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection))
            bs.sampled_type = dr.select(glossy, *kinds)
            active &= bs.pdf > 0
            return bs, dr.select(active, self.eval(ctx, si, bs.wo, active) / bs.pdf, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Glossy[roughness={self.roughness}, shininess={self.shininess}]"

    mi.register_bsdf("warp_ar_glossy", Glossy)
    return "warp_ar_glossy"


def material(item: Object) -> Dict:
    """What an object is made of.

    Raises:
        UsageError: Mitsuba is not told of such a material.
    """
    own = item.material
    if isinstance(own, LambertMaterial):
        return matt(own.base_color)
    if isinstance(own, MirrorMaterial):
        return mirror(own.base_color)
    if isinstance(own, MetallicRoughnessMaterial):
        numbers = {"metallic": float(own.metallic), "roughness": float(own.roughness), "shininess": -1.0}
        return {"type": register_glossy(), "base": rgb(own.base_color), "specular": rgb((0, 0, 0)), **numbers}
    if isinstance(own, PhongMaterial):
        numbers = {"metallic": 0.0, "roughness": 1.0, "shininess": float(own.shininess)}
        return {"type": register_glossy(), "base": rgb(own.diffuse), "specular": rgb(own.specular), **numbers}
    raise UsageError(f"material of the object {item.shape}: expected one that the scene file gives")


def _place(rotation: Any, position: Any, scale: float) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * np.asarray(rotation), position
    return mi.ScalarTransform4f(matrix)


def _mesh(mesh: Mesh, place: Any, bsdf: Dict, name: str) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=properties)
    matrix = np.array(place.matrix, np.float64)
    points = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    normals = mesh.normals @ (matrix[:3, :3].T / np.cbrt(np.linalg.det(matrix[:3, :3])))
    values = mi.traverse(shape)
    values["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
    values["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
    values["faces"] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    values.update()
    return shape


def _shape(item: Object | Proxy, bsdf: Dict, place: Any, name: str) -> Any:
    """A shape that stands where it does in the scene."""
    turn = mi.ScalarTransform4f
    if item.shape == "plane":
        return {"type": "rectangle", "to_world": place @ turn().scale([*(0.5 * s for s in item.size), 1]), "bsdf": bsdf}
    if item.shape == "box":
        return {"type": "cube", "to_world": place @ turn().scale([0.5 * s for s in item.size]), "bsdf": bsdf}
    if isinstance(item, Object) and item.shape == "sphere":
        return {"type": "sphere", "to_world": place @ turn().scale(item.radius), "bsdf": bsdf}
    if isinstance(item, Object) and item.shape == "torus":
        gap = silhouette_tolerance(item.scale * (item.major_radius + item.minor_radius)) / item.scale
        return _mesh(torus_mesh(item.major_radius, item.minor_radius, gap), place, bsdf, name)
    assert item.file is not None
    return _mesh(file_mesh(item.file), place, bsdf, name)


def _light(light: Light, seconds: float) -> Dict:
    position, direction = light.pose_at(seconds)
    power = rgb(np.array(light.color) * light.intensity)
    if light.attenuation != (0.0, 0.0, 1.0) or light.kind == "directional":
        raise UsageError(f"light of kind {light.kind!r}: expected a point or spot with attenuation (0, 0, 1)")
    if light.kind == "point":
        return {"type": "point", "position": position.tolist(), "intensity": power}
    up = np.eye(3)[np.argmin(np.abs(direction))]
    aim = mi.ScalarTransform4f().look_at(position.tolist(), (position + direction).tolist(), up.tolist())
    angles = {"cutoff_angle": light.outer_angle, "beam_width": light.inner_angle}
    return {"type": "spot", "to_world": aim, "intensity": power, **angles}


def environment(radiance: Float) -> Dict:
    """A latlong map as Mitsuba looks it up: bilinear between the same texels.

    Mitsuba's rows lie from pole to pole, so that between two of the map's rows one is their mean, and beyond a pole
    lies its other side; its columns turn the other way, from +y.
    """
    height, width = radiance.shape[:2]
    if width != 2 * height or width % 4:
        raise UsageError(f"map of {width}x{height}: expected twice as many columns as rows, a multiple of 4")
    around = np.roll(radiance, width // 2, axis=1)
    tall = np.concatenate([around[:1], radiance, around[-1:]])
    rows = np.empty((2 * height + 1, width, 3), np.float32)
    rows[1::2] = radiance
    rows[0::2] = 0.5 * (tall[:-1] + tall[1:])
    columns = (3 * width // 4 - np.arange(width) - 1) % width
    bitmap = mi.Bitmap(np.ascontiguousarray(rows[:, columns]))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}


def sensor(camera: Camera, pose: Pose) -> Dict:
    """A camera without distortion."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = pose.rotation.T @ np.diag([-1.0, -1.0, 1.0])
    world_from_camera[:3, 3] = -pose.rotation.T @ pose.translation
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb"}
    return {
        "type": "perspective",
        "fov": 2.0 * math.degrees(math.atan(0.5 * camera.width / camera.fx)),
        "principal_point_offset_x": (camera.cx + 0.5) / camera.width - 0.5,
        "principal_point_offset_y": (camera.cy + 0.5) / camera.height - 0.5,
        "to_world": mi.ScalarTransform4f(world_from_camera),
        "film": {**film, "rfilter": {"type": "box"}, "component_format": "float32"},
    }


def mitsuba_scene(
    scene: Scene, light: Float, pose: Pose, reflectances: Sequence[Any], *, virtual: bool, seconds: float = 0.0
) -> Any:
    """A scene with or without its objects and lights.

    Args:
        scene: With its camera at the picture's size.
        light: Latlong radiance (h, 2 h, 3), the whole environment.
        pose: ``camera_from_world``.
        reflectances: RGB of each proxy.
        virtual: Whether objects and lights are there.
        seconds: Since the first frame.

    Raises:
        UsageError: Something of it cannot be said to Mitsuba.
    """
    items: Dict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 40},
        "sensor": sensor(scene.camera, pose),
        "sky": environment(light),
    }
    for k, (proxy, color) in enumerate(zip(scene.proxies, reflectances, strict=True)):
        place = _place(rotation_matrix(proxy.rotate), proxy.at, 1.0)
        items[f"proxy_{k}"] = _shape(proxy, matt(color), place, f"proxy_{k}")
    for k, ball in enumerate(scene.probes):
        shape = {"type": "sphere", "center": list(ball.center), "radius": ball.radius}
        items[f"ball_{k}"] = {**shape, "bsdf": mirror(ball.reflectance)}
    if virtual:
        for k, item in enumerate(scene.objects):
            rotation, position = item.pose_at(seconds)
            place = _place(rotation, position, item.scale)
            items[f"object_{k}"] = _shape(item, material(item), place, f"object_{k}")
        for k, lamp in enumerate(scene.lights):
            items[f"light_{k}"] = _light(lamp, seconds)
    return mi.load_dict(items)
