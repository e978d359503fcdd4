"""Sections of a scene file about virtual content: objects, their materials and motion, lights."""

from __future__ import annotations

from typing import Any, cast

from warp_ar.scene.description import Animation, AreaLight, Light, Object, Play
from warp_ar.scene.keys import AREA_LIGHT_KEYS, LIGHT_KEYS, MATERIALS, OBJECT_KEYS, keys_of
from warp_ar.scene.materials import (
    EmissiveMaterial,
    FileMaterial,
    LambertMaterial,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)
from warp_ar.scene.mesh_files import GLTF_SUFFIXES
from warp_ar.scene.messages import SMALLEST
from warp_ar.scene.read_physical import _read_mesh_path, read_own_marker
from warp_ar.scene.scene_table import SceneTable


def read_object(table: SceneTable) -> Object:
    """An ``[[object]]``."""
    shape = table.choice("shape", OBJECT_KEYS)
    table.only("shape", OBJECT_KEYS[shape], (key for keys in OBJECT_KEYS.values() for key in keys))
    major = table.length("major_radius") if shape == "torus" else Object.major_radius
    minor = table.length("minor_radius") if shape == "torus" else Object.minor_radius
    if shape == "torus" and minor >= major:
        table.fail("minor_radius", f"must be below major_radius ({major:g}), else the torus has no hole")
    return Object(
        shape=cast(Any, shape),
        file=_read_mesh_path(table) if shape == "mesh" else None,
        radius=table.length("radius") if "radius" in OBJECT_KEYS[shape] else Object.radius,
        size=_read_size(table, shape),
        length=table.length("length") if shape == "tube" else Object.length,
        major_radius=major,
        minor_radius=minor,
        at=table.vec3("at", Object.at, unit="metres"),
        rotate=table.vec3("rotate", Object.rotate, unit="degrees"),
        scale=table.number("scale", Object.scale, low=SMALLEST),
        material=_read_material(table) if "material" in table else Object.material,
        animate=_read_animation(table),
        play=_read_play(table, shape),
        marker=read_own_marker(table),
    )


def _read_size(table: SceneTable, shape: str) -> tuple[float, ...]:
    """Whole lengths of a rect or a box."""
    sides = {"rect": 2, "box": 3}.get(shape)
    return Object.size if sides is None else table.vector("size", sizes=(sides,), low=SMALLEST, unit="metres")


def _read_material(parent: SceneTable) -> Material:
    known = ["model", *keys_of(*MATERIALS.values())]
    table = parent.inner("material", parent.data["material"], known)
    model = table.choice("model", MATERIALS)
    kind = MATERIALS[model]
    table.only("model", keys_of(kind), known[1:])
    if kind is FileMaterial:
        return FileMaterial()
    if kind is PhongMaterial:
        return PhongMaterial(
            diffuse=table.reflectance("diffuse", PhongMaterial.diffuse),
            specular=table.reflectance("specular", PhongMaterial.specular),
            shininess=table.number("shininess", PhongMaterial.shininess, low=0.0),
        )
    if kind is MetallicRoughnessMaterial:
        return MetallicRoughnessMaterial(
            base_color=table.reflectance("base_color", MetallicRoughnessMaterial.base_color),
            metallic=table.number("metallic", MetallicRoughnessMaterial.metallic, low=0.0, high=1.0),
            roughness=table.number("roughness", MetallicRoughnessMaterial.roughness, low=0.0, high=1.0),
        )
    if kind is LambertMaterial:
        return LambertMaterial(table.reflectance("base_color", LambertMaterial.base_color))
    if kind is EmissiveMaterial:
        return EmissiveMaterial(
            color=table.vec3("color", EmissiveMaterial.color, low=0.0),
            intensity=table.number("intensity", EmissiveMaterial.intensity, low=0.0),
            image=table.file("image", "a picture") if "image" in table else None,
            two_sided=table.flag("two_sided", EmissiveMaterial.two_sided),
        )
    return MirrorMaterial(table.reflectance("base_color", MirrorMaterial.base_color))


def _read_animation(parent: SceneTable) -> Animation | None:
    if "animate" not in parent:
        return None
    table = parent.inner("animate", parent.data["animate"], keys_of(Animation))
    if "period" in table and "sway" not in table:
        table.fail("period", "is the duration of a swing; give sway too, its excursion in metres")
    if "pivot" in table and "turn" not in table:
        table.fail("pivot", "is the point to turn about; give turn too, in degrees per second")
    return Animation(
        turn=table.vec3("turn", Animation.turn, unit="degrees per second"),
        pivot=table.vec3("pivot", unit="metres") if "pivot" in table else None,
        sway=table.vec3("sway", Animation.sway, unit="metres"),
        period=table.number("period", Animation.period, low=1e-3, unit="seconds"),
    )


def _read_area_light(table: SceneTable, kind: str) -> AreaLight:
    return AreaLight(
        kind=cast(Any, kind),
        intensity=table.number("intensity", low=0.0),
        color=table.vec3("color", AreaLight.color, low=0.0),
        at=table.vec3("at", unit="metres"),
        rotate=table.vec3("rotate", AreaLight.rotate, unit="degrees"),
        size=_read_size(table, kind) if kind == "rect" else AreaLight.size,
        radius=table.length("radius") if kind != "rect" else AreaLight.radius,
        length=table.length("length") if kind == "tube" else AreaLight.length,
        image=table.file("image", "a picture") if "image" in table else None,
        two_sided=table.flag("two_sided", AreaLight.two_sided),
        animate=_read_animation(table),
        marker=read_own_marker(table),
    )


def _read_play(parent: SceneTable, shape: str) -> Play | None:
    if "play" not in parent:
        return None
    if shape != "mesh" or _read_mesh_path(parent).suffix.lower() not in GLTF_SUFFIXES:
        parent.fail("play", f"plays an animation of a file; give one that ends in {' or '.join(GLTF_SUFFIXES)}")
    table = parent.inner("play", parent.data["play"], keys_of(Play))
    animation: str | int = Play.animation
    if isinstance(table.data.get("animation"), str):
        animation = table.text("animation", right="an animation's name, or its number from 0 on")
    elif "animation" in table:
        animation = table.integer("animation", low=0)
    return Play(
        animation=animation,
        loop=table.flag("loop", Play.loop),
        start=table.number("start", Play.start, unit="seconds"),
        offset=table.number("offset", Play.offset, low=0.0, unit="seconds"),
        paused=table.flag("paused", Play.paused),
        speed=table.number("speed", Play.speed, low=SMALLEST),
    )


def read_light(table: SceneTable) -> Light | AreaLight:
    """A ``[[light]]`` that is virtual."""
    kinds = {**LIGHT_KEYS, **AREA_LIGHT_KEYS}
    kind = table.choice("kind", kinds)
    table.only("kind", kinds[kind], (key for keys in kinds.values() for key in keys))
    if kind in AREA_LIGHT_KEYS:
        return _read_area_light(table, kind)
    spot = kind == "spot"
    at = Light.at if kind == "directional" else table.vec3("at", unit="metres")
    target = table.vec3("target", unit="metres") if "target" in table else None
    direction = None
    if target is not None:
        if "direction" in table:
            table.fail("direction", "target is given too; expected exactly one of the two")
        if target == at:
            table.fail("target", "is where the light itself is; move one of the two")
    elif kind != "point":
        if spot and "direction" not in table:
            table.fail("target", "a spot light needs a target (a point) or a direction")
        direction = table.vec3("direction")
        if not any(abs(component) >= SMALLEST for component in direction):
            table.fail("direction", "has no length; expected the way the light travels, such as [0, 0, -1]")
    outer = table.number("outer_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.outer_angle
    inner = table.number("inner_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.inner_angle
    if inner > outer:
        table.fail("inner_angle", f"must not be above outer_angle ({outer:g})")
    attenuation = table.vec3("attenuation", Light.attenuation, low=0.0)
    if not any(term >= SMALLEST for term in attenuation):
        table.fail("attenuation", "is zero everywhere; expected constant, linear and quadratic term, such as [0, 0, 1]")
    return Light(
        kind=cast(Any, kind),
        intensity=table.number("intensity", low=0.0),
        color=table.vec3("color", Light.color, low=0.0),
        at=at,
        target=target,
        direction=direction,
        inner_angle=inner,
        outer_angle=outer,
        attenuation=attenuation,
        radius=table.number("radius", Light.radius, low=0.0, unit="metres"),
        animate=_read_animation(table),
        marker=read_own_marker(table),
    )
