"""Virtual objects and lights of a scene file in Mitsuba's terms, for path-traced truth."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from make_shapes import Dict, glossy, grid_mesh, matte, mirror, rgb

HERE = pathlib.Path(__file__).resolve().parent


def leaving_share(exponent: float, count: int = 512) -> np.ndarray:
    """Return the share of a Phong lobe above the surface, for ``count`` cosines of the mirror direction from 0 to 1.

    The lobe consists of cones around the mirror direction, of the cosine u^(1 / (n + 1)). The result is the mean, over
    u, of the share of a cone that lies above the surface.
    """
    cosine = ((np.arange(4096) + 0.5) / 4096) ** (1 / (exponent + 1))
    sine = np.sqrt(1 - cosine**2)
    up = np.linspace(0, 1, count)[:, None]
    # Around the mirror direction a ray rises to up * cosine + sqrt(1 - up^2) * sine * cos(turn).
    lowest = -up * cosine / np.maximum(np.sqrt(1 - up**2) * sine, 1e-9)
    return (np.arccos(np.clip(lowest, -1, 1)) / np.pi).mean(axis=1)


@functools.cache
def register_phong() -> str:
    """Register the Phong model of ``warp_ar.kernels.materials``, which Mitsuba lacks, and return its name.

    It has a diffuse part and a lobe. The lobe reflects the mean of the arriving radiance over the directions above the
    surface, weighted by cos^n of the angle to the mirror direction.
    """
    import drjit as dr

    class Phong(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.diffuse, self.specular = (mi.Color3f(props[name]) for name in ("diffuse", "specular"))
            self.exponent = props["exponent"]
            self.leaving = mi.Float(leaving_share(self.exponent).astype(np.float32))
            flags = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection
            self.m_components = [flag | mi.BSDFFlags.FrontSide for flag in flags]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def lobe(self, si: Any, wo: Any) -> Any:
            """Return the lobe's density, per steradian, for directions above the surface; 0 below it."""
            mirrored = mi.reflect(si.wi)
            place = dr.maximum(mi.Frame3f.cos_theta(mirrored), 0) * (dr.width(self.leaving) - 1)
            low = dr.minimum(mi.UInt32(place), dr.width(self.leaving) - 2)
            below, above = (dr.gather(mi.Float, self.leaving, low + k) for k in (0, 1))
            share = dr.lerp(below, above, place - low)
            power = dr.power(dr.maximum(dr.dot(mirrored, wo), 0), self.exponent)
            return dr.select(mi.Frame3f.cos_theta(wo) > 0, (self.exponent + 1) / (2 * dr.pi) * power / share, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            scattered = mi.warp.square_to_cosine_hemisphere(sample2)
            cosine = dr.power(sample2.x, 1 / (self.exponent + 1))
            sine, turn = dr.safe_sqrt(1 - cosine * cosine), 2 * dr.pi * sample2.y
            around = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), cosine)
            glossy = sample1 < 0.5
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(glossy, mi.Frame3f(mi.reflect(si.wi)).to_world(around), scattered)
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            bs.sampled_type = dr.select(
                glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            active &= bs.pdf > 0
            return bs, dr.select(active, self.eval(ctx, si, bs.wo, active) / bs.pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            active &= (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            value = self.diffuse * mi.warp.square_to_cosine_hemisphere_pdf(wo)
            return dr.select(active, value + self.specular * self.lobe(si, wo), 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            active &= (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            # Not divided by the share that leaves: rays into the surface are lost, and weighted so.
            place = dr.dot(mi.reflect(si.wi), wo)
            glossy = (self.exponent + 1) / (2 * dr.pi) * dr.power(dr.maximum(place, 0), self.exponent)
            return dr.select(active, 0.5 * (glossy + mi.warp.square_to_cosine_hemisphere_pdf(wo)), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Phong[exponent={self.exponent}]"

    mi.register_bsdf("phong", Phong)
    return "phong"


def virtual_material(material: Dict) -> Dict:
    model = material["model"]
    if model == "metallic_roughness":
        return glossy(material["base_color"], material["roughness"], material["metallic"])
    if model == "phong":
        return {"type": register_phong()} | {
            "diffuse": rgb(material["diffuse"]),
            "specular": rgb(material["specular"]),
            "exponent": float(material["shininess"]),
        }
    return mirror(material["base_color"]) if model == "mirror" else matte(material["base_color"])


def placed(item: Dict) -> Any:
    """Return the transform of an object or a light: its position and rotation in the scene file."""
    t = mi.ScalarTransform4f()
    rx, ry, rz = item.get("rotate", (0, 0, 0))
    return (
        t.translate(item.get("at", [0, 0, 0]))
        @ t.rotate([0, 0, 1], rz)
        @ t.rotate([0, 1, 0], ry)
        @ t.rotate([1, 0, 0], rx)
    )


def picture_of(image: Any, channel: int | None = None) -> Dict:
    """Return Mitsuba's texture of a glTF's picture, its codes as numbers from 0 to 1: all channels, or one."""
    values = np.asarray(image.convert("RGB"), np.float32) / 255.0
    values = values if channel is None else values[..., channel : channel + 1]
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values)), "raw": True}


def file_material(material: Any) -> Dict:
    """Return Mitsuba's form of a glTF's material, read by trimesh; factors on pictures must be 1."""
    color = np.array(material.baseColorFactor if material.baseColorFactor is not None else (255,) * 4) / 255.0
    base: Any = color[:3]
    if material.baseColorTexture is not None:
        codes = np.asarray(material.baseColorTexture.convert("RGB")) / 255.0
        linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
        base = {"type": "bitmap", "bitmap": mi.Bitmap(linear.astype(np.float32)), "raw": True}
    made = glossy(base, material.roughnessFactor, material.metallicFactor)
    if material.metallicRoughnessTexture is not None:
        made |= {
            name: picture_of(material.metallicRoughnessTexture, channel)
            for name, channel in (("roughness", 1), ("metallic", 2))
        }
    if material.normalTexture is not None:
        made = {"type": "normalmap", "normalmap": picture_of(material.normalTexture), "bsdf": made}
    return {"type": "twosided", "bsdf": made}


def file_mesh(path: pathlib.Path, place: Any) -> list[Any]:
    """Return the parts of a glTF with the file's materials, turned from +Y up to +Z up.

    trimesh reads the file, so that errors of ``warp_ar``'s own reader show in comparisons with this truth.
    """
    upright = place @ mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    parts = []
    scene = trimesh.load(path)
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        world = np.array(upright.matrix) @ matrix
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(file_material(part.visual.material))
        made = mi.Mesh(
            name, len(part.vertices), len(part.faces), props, has_vertex_normals=True, has_vertex_texcoords=True
        )
        values = mi.traverse(made)
        values["vertex_positions"] = (part.vertices @ world[:3, :3].T + world[:3, 3]).astype(np.float32).ravel()
        normals = part.vertex_normals @ np.linalg.inv(world[:3, :3])
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        values["vertex_normals"] = normals.astype(np.float32).ravel()
        # Mitsuba's v runs down, trimesh's up.
        values["vertex_texcoords"] = (part.visual.uv * [1, -1] + [0, 1]).astype(np.float32).ravel()
        values["faces"] = part.faces.astype(np.uint32).ravel()
        values.update()
        parts.append(made)
    return parts


def virtual_object(item: Dict, folder: pathlib.Path) -> Dict:
    t = mi.ScalarTransform4f()
    place = placed(item) @ t.scale(item.get("scale", 1.0))
    if "material" not in item:
        return {f"part{k}": part for k, part in enumerate(file_mesh(HERE / item["file"], place))}
    bsdf = virtual_material(item["material"])
    if item["shape"] == "mesh":
        return {
            "type": "ply",
            "filename": str(HERE / item["file"]),
            "to_world": place,
            "bsdf": {"type": "twosided", "bsdf": bsdf},
        }
    if item["shape"] == "sphere":
        return {"type": "sphere", "to_world": place @ t.scale(item["radius"]), "bsdf": bsdf}
    if item["shape"] == "box":
        return {"type": "cube", "to_world": place @ t.scale([s / 2 for s in item["size"]]), "bsdf": bsdf}
    u, v = np.meshgrid(*(np.linspace(0, 2 * np.pi, n) for n in (193, 97)), indexing="ij")
    v = -v[:, :-1]
    u = u[:, :-1]
    ring = item["major_radius"] + item["minor_radius"] * np.cos(v)
    return grid_mesh(
        folder,
        "torus",
        np.stack([ring * np.cos(u), ring * np.sin(u), item["minor_radius"] * np.sin(v)], -1),
        bsdf,
        place,
    )


def virtual_rect(light: Dict) -> Dict:
    """Return a rectangle that emits toward its +z; the top of its picture, if it has one, is at +y."""
    factor = np.array(light.get("color", (1.0, 1.0, 1.0))) * light["intensity"]
    radiance: Dict = rgb(factor)
    if "image" in light:
        codes = np.array(mi.Bitmap(str(HERE / light["image"])))[::-1, :, :3] / 255.0
        linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
        bitmap = mi.Bitmap(np.ascontiguousarray(linear * factor, np.float32))
        radiance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    width, height = light["size"]
    place = placed(light) @ mi.ScalarTransform4f().scale([0.5 * width, 0.5 * height, 1.0])
    black = {"type": "diffuse", "reflectance": rgb(np.zeros(3))}
    return {
        "type": "rectangle",
        "to_world": place,
        "bsdf": black,
        "emitter": {"type": "area", "radiance": radiance},
    }


def virtual_light(light: Dict) -> Dict:
    if light["kind"] == "rect":
        return virtual_rect(light)
    power = rgb(np.array(light["color"]) * light["intensity"])
    if light["kind"] == "point":
        return {"type": "point", "position": light["at"], "intensity": power}
    if light["kind"] == "spot":
        aim = mi.ScalarTransform4f().look_at(origin=light["at"], target=light["target"], up=[0.1, 1, 0.2])
        return {
            "type": "spot",
            "to_world": aim,
            "intensity": power,
            "cutoff_angle": light["outer_angle"],
            "beam_width": light["inner_angle"],
        }
    raise ValueError(f"truth is not made for lights of kind {light['kind']!r}")
