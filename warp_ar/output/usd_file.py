"""Export of a shot as USD (``.usda``, ``.usdc``, ``.usd``); needs ``usd-core``, from the extra ``exchange``.

z is up and the unit is a metre. The camera's apertures encode its principal point and both focal lengths, so its
frustum is that of the undistorted frames; USD has no lens distortion (see ``stmap``). Proxies are below
``/shot/proxies``, virtual objects below ``/shot/objects``. A light's ``normalize`` makes its power independent of its
size: a white surface that faces a sphere light of intensity i at distance d has radiance i / (4 pi d^2), so i = 4 I for
a radiant intensity I.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.files import store
from warp_ar.output.shot import FILM_WIDTH, Body, ExchangeMaterial, Matrix, Shot, key_frames, texture_plan
from warp_ar.scene.description import Light
from warp_ar.scene.materials import IDENTITY
from warp_ar.scene.pose_file import load_usd
from warp_ar.signature import PROGRAM

USD_SUFFIXES = (".usda", ".usdc", ".usd")

SUN_DEGREES = 0.53
"""Angular diameter of a directional light in degrees: the sun's."""
_COORDINATES = ("st", "st1")
"""Names of the two sets of texture coordinates."""
RGBA: TypeAlias = tuple[float, float, float, float]
_TENTHS = 10.0
"""Factor on a USD camera's lens lengths, whose unit is a tenth of the stage's unit."""


def write_usd(path: Path, shot: Shot) -> list[Path]:
    """Write a shot as USD, with textures beside it.

    Args:
        path: Path with one of the suffixes ``USD_SUFFIXES``.
        shot: The shot.

    Returns:
        The files that were written.

    Raises:
        UsageError: USD is not installed.
        SinkError: A file cannot be written.
    """
    pxr = load_usd()
    stage = pxr.Usd.Stage.CreateInMemory(f"shot{path.suffix}")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(shot.fps)
    stage.SetFramesPerSecond(shot.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(max(0, len(shot.poses) - 1))
    root = pxr.UsdGeom.Xform.Define(stage, "/shot")
    stage.SetDefaultPrim(root.GetPrim())
    plate = {} if shot.plate is None else {"plate": shot.plate.as_posix()}
    stage.GetRootLayer().customLayerData = {"program": PROGRAM, **plate}
    written = [path]
    _write_camera(pxr, stage, shot)
    for body in shot.bodies():
        written += _write_body(pxr, stage, body, path)
    for index, light in enumerate(shot.scene.lights):
        _write_light(pxr, stage, f"/shot/lights/light_{index}", light, shot)
    if shot.environment is not None:
        _write_dome(pxr, stage, "/shot/lights/environment", shot.environment)
    for ball, (file, at) in enumerate(shot.others, 1):
        # Light at another position: programs that interpolate or choose can use it, and none adds it to the first.
        prim = _write_dome(pxr, stage, f"/shot/lights/environment_{ball}", file)
        prim.SetCustomDataByKey("at", pxr.Gf.Vec3d(*at))
        prim.SetActive(False)
    store(path, lambda part: _export(stage, part), suffix=path.suffix)
    return written


def _write_dome(pxr: Any, stage: Any, path: str, file: Path) -> Any:
    """Write the dome light of an environment, and return its prim."""
    dome = pxr.UsdLux.DomeLight.Define(stage, path)
    dome.CreateIntensityAttr(1.0)
    dome.CreateTextureFileAttr(f"./{file.name}")
    dome.CreateTextureFormatAttr(pxr.UsdLux.Tokens.latlong)
    # A dome's pole is its own y axis.
    dome.AddRotateXOp().Set(90.0)
    return dome.GetPrim()


def _export(stage: Any, part: Path) -> None:
    if not stage.GetRootLayer().Export(str(part)):
        raise OSError(f"USD cannot write {part}")


def _place(pxr: Any, prim: Any, placements: dict[int, Matrix]) -> None:
    """Set a prim's transform by frame; USD's matrices are for row vectors."""
    operation = prim.AddTransformOp()
    if len(placements) == 1:
        operation.Set(pxr.Gf.Matrix4d(*next(iter(placements.values())).T.reshape(-1).tolist()))
        return
    for frame, matrix in placements.items():
        operation.Set(pxr.Gf.Matrix4d(*matrix.T.reshape(-1).tolist()), frame)


def _write_camera(pxr: Any, stage: Any, shot: Shot) -> None:
    camera = shot.camera
    prim = pxr.UsdGeom.Camera.Define(stage, "/shot/camera")
    focal = FILM_WIDTH * camera.fx / camera.width
    scale = _TENTHS * focal
    prim.CreateFocalLengthAttr(scale)
    prim.CreateHorizontalApertureAttr(scale * camera.width / camera.fx)
    prim.CreateVerticalApertureAttr(scale * camera.height / camera.fy)
    # Offset of the picture's centre; pixel centres are at integers, and y is up.
    prim.CreateHorizontalApertureOffsetAttr(scale * (0.5 * (camera.width - 1) - camera.cx) / camera.fx)
    prim.CreateVerticalApertureOffsetAttr(scale * (camera.cy - 0.5 * (camera.height - 1)) / camera.fy)
    prim.CreateClippingRangeAttr(pxr.Gf.Vec2f(0.01, 1000.0))
    sdf = pxr.Sdf.ValueTypeNames
    own = prim.GetPrim()
    own.CreateAttribute("warp_ar:size", sdf.Int2).Set(pxr.Gf.Vec2i(camera.width, camera.height))
    own.CreateAttribute("warp_ar:intrinsics", sdf.Double4).Set(pxr.Gf.Vec4d(camera.fx, camera.fy, camera.cx, camera.cy))
    own.CreateAttribute("warp_ar:distortion", sdf.DoubleArray).Set(pxr.Vt.DoubleArray(list(camera.distortion)))
    if shot.plate is not None:
        own.CreateAttribute("warp_ar:plate", sdf.Asset).Set(pxr.Sdf.AssetPath(shot.plate.as_posix()))
    placements = shot.camera_placements()
    if placements:
        _place(pxr, prim, placements)


def _write_body(pxr: Any, stage: Any, body: Body, path: Path) -> list[Path]:
    folder = "proxies" if body.proxy else "objects"
    prim = pxr.UsdGeom.Mesh.Define(stage, f"/shot/{folder}/{body.name}")
    mesh = body.mesh
    prim.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(mesh.vertices))
    prim.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1))))
    prim.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(mesh.normals))
    prim.SetNormalsInterpolation(pxr.UsdGeom.Tokens.vertex)
    prim.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    prim.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.bounds)))
    prim.CreateDoubleSidedAttr(any(material.own.double_sided for material in body.materials))
    primvars = pxr.UsdGeom.PrimvarsAPI(prim)
    for name, coordinates in zip(_COORDINATES, (mesh.uvs, mesh.uvs_second), strict=True):
        if coordinates is not None:
            made = primvars.CreatePrimvar(name, pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.vertex)
            made.Set(pxr.Vt.Vec2fArray.FromNumpy(coordinates))
    if body.colors is not None:
        made = primvars.CreatePrimvar("displayColor", pxr.Sdf.ValueTypeNames.Color3fArray, pxr.UsdGeom.Tokens.vertex)
        made.Set(pxr.Vt.Vec3fArray.FromNumpy(_base_colors(body)))
    prim.GetPrim().CreateAttribute("warp_ar:proxy", pxr.Sdf.ValueTypeNames.Bool).Set(body.proxy)
    _place(pxr, prim, dict(enumerate(key_frames(body.placements))))
    return _write_materials(pxr, stage, body, prim, path)


def _base_colors(body: Body) -> npt.NDArray[np.float32]:
    """Return base colours at vertices, (n, 3), including the materials': USD's surface cannot multiply colours."""
    assert body.colors is not None
    found = np.ascontiguousarray(body.colors[:, :3])
    for number, material in enumerate(body.materials):
        own = np.unique(body.mesh.faces[body.triangles_of(number)])
        found[own] = body.colors[own, :3] * np.array(material.base_color, np.float32)
    return found


def _write_materials(pxr: Any, stage: Any, body: Body, prim: Any, path: Path) -> list[Path]:
    """Write the materials, each for its triangles, and their pictures beside the file."""
    plan = texture_plan(path, body.name, body.materials)
    written: dict[Path, None] = {}
    for number, material in enumerate(body.materials):
        for kind, picture in material.pictures.items():
            file = plan[number, kind]
            if file not in written:
                store(file, picture.encode())
                written[file] = None
        where = f"/shot/materials/{body.name}" + (f"_{number}" if number else "")
        files = {kind: plan[number, kind] for kind in material.pictures}
        bound = _Material(pxr, stage, where, material, files).write(colored=body.colors is not None)
        target = prim.GetPrim()
        if len(body.materials) > 1:
            chosen = pxr.Vt.IntArray.FromNumpy(body.triangles_of(number).astype(np.int32))
            subset = pxr.UsdShade.MaterialBindingAPI(prim).CreateMaterialBindSubset(f"material_{number}", chosen)
            target = subset.GetPrim()
        pxr.UsdShade.MaterialBindingAPI.Apply(target).Bind(bound)
    return list(written)


class _Material:
    """Writer of a material as UsdPreviewSurface, with its pictures."""

    def __init__(self, pxr: Any, stage: Any, where: str, material: ExchangeMaterial, files: dict[str, Path]) -> None:
        self._pxr, self._stage, self._where, self._material, self._files = pxr, stage, where, material, files

    def write(self, *, colored: bool) -> Any:
        """Return the material.

        With ``colored``, the mesh's ``displayColor`` is the base colour if there is no picture.
        """
        material, own, files = self._material, self._material.own, self._files
        inputs: dict[str, tuple[str, Any]] = {}
        color, emission, opacity = material.base_color, own.emission, own.opacity
        roughness, metallic = material.roughness, material.metallic
        if material.specular is not None:
            inputs |= {"useSpecularWorkflow": ("Int", 1), "specularColor": ("Color3f", material.specular)}
        if "" in files:
            channel = self._read("", (*material.base_color, own.opacity), space="sRGB")
            color, opacity = channel("rgb"), channel("a")
        elif colored:
            reader = self._shader("colors", "UsdPrimvarReader_float3", {"varname": ("String", "displayColor")})
            color = reader.CreateOutput("result", self._pxr.Sdf.ValueTypeNames.Float3)
        if "emission" in files and not own.unlit:
            emission = self._read("emission", (*own.emission, 1.0), space="sRGB")("rgb")
        # An unlit material has neither reflection nor diffuse light.
        color, emission = ((0.0, 0.0, 0.0), color) if own.unlit else (color, emission)
        inputs["diffuseColor"] = "Color3f", color
        if own.unlit or any(own.emission):
            inputs["emissiveColor"] = "Color3f", emission
        if "metallic_roughness" in files:
            channel = self._read("metallic_roughness", (1.0, roughness, metallic, 1.0))
            roughness, metallic = channel("g"), channel("b")
        inputs |= {"roughness": ("Float", roughness), "metallic": ("Float", metallic)}
        if "normal" in files:
            s = own.normal_scale
            normal = self._read("normal", (2.0 * s, 2.0 * s, 2.0, 1.0), (-s, -s, -1.0, 0.0))
            inputs["normal"] = "Normal3f", normal("rgb")
        if "occlusion" in files:
            s = own.occlusion_strength
            inputs["occlusion"] = (
                "Float",
                self._read("occlusion", (s, s, s, 1.0), (1.0 - s, 1.0 - s, 1.0 - s, 0.0))("r"),
            )
        if own.alpha != "opaque":
            inputs["opacity"] = "Float", opacity
        if own.alpha == "mask":
            inputs["opacityThreshold"] = "Float", own.cutoff
        made = self._pxr.UsdShade.Material.Define(self._stage, self._where)
        surface = self._shader("surface", "UsdPreviewSurface", inputs)
        made.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        return made

    def _shader(self, name: str, kind: str, inputs: Mapping[str, tuple[str, Any]]) -> Any:
        """Return a shader; each input has a type, and a value or another shader's output."""
        shader = self._pxr.UsdShade.Shader.Define(self._stage, f"{self._where}/{name}")
        shader.CreateIdAttr(kind)
        for key, (form, value) in inputs.items():
            made = shader.CreateInput(key, getattr(self._pxr.Sdf.ValueTypeNames, form))
            if isinstance(value, self._pxr.UsdShade.Output):
                made.ConnectToSource(value)
            else:
                made.Set(value)
        return shader

    def _read(
        self, kind: str, scale: RGBA, bias: RGBA = (0.0, 0.0, 0.0, 0.0), space: str = "raw"
    ) -> Callable[[str], Any]:
        """Return the outputs, by channel, of a picture at its texture coordinates, times ``scale`` plus ``bias``."""
        picture, names = self._material.pictures[kind], self._pxr.Sdf.ValueTypeNames
        name, coordinates = kind or "texture", _COORDINATES[picture.use.uv_set]
        reader = self._shader(coordinates, "UsdPrimvarReader_float2", {"varname": ("String", coordinates)})
        source = reader.CreateOutput("result", names.Float2)
        if picture.use.transform != IDENTITY:
            across, up, turn, c, f = picture.placing
            placing = {"in": source, "scale": (across, up), "translation": (c, f)}
            inputs = {key: ("Float2", value) for key, value in placing.items()}
            inputs["rotation"] = "Float", math.degrees(turn)
            source = self._shader(f"{name}_place", "UsdTransform2d", inputs).CreateOutput("result", names.Float2)
        texture = self._shader(
            name,
            "UsdUVTexture",
            {
                "file": ("Asset", f"./{self._files[kind].name}"),
                "sourceColorSpace": ("Token", space),
                "scale": ("Float4", scale),
                "bias": ("Float4", bias),
                "wrapS": ("Token", picture.use.wrap[0]),
                "wrapT": ("Token", picture.use.wrap[1]),
                "st": ("Float2", source),
            },
        )
        return lambda channel: texture.CreateOutput(channel, names.Float3 if channel == "rgb" else names.Float)


def _write_light(pxr: Any, stage: Any, where: str, light: Light, shot: Shot) -> None:
    directional = light.kind == "directional"
    kind = pxr.UsdLux.DistantLight if directional else pxr.UsdLux.SphereLight
    prim = kind.Define(stage, where)
    prim.CreateColorAttr(pxr.Gf.Vec3f(*light.color))
    prim.CreateNormalizeAttr(True)
    if directional:
        prim.CreateIntensityAttr(light.intensity)
        prim.CreateAngleAttr(SUN_DEGREES)
    else:
        prim.CreateIntensityAttr(4.0 * light.intensity)
        prim.CreateRadiusAttr(light.radius or 1e-4)
        prim.CreateTreatAsPointAttr(light.radius == 0.0)
    if light.kind == "spot":
        shaping = pxr.UsdLux.ShapingAPI.Apply(prim.GetPrim())
        shaping.CreateShapingConeAngleAttr(light.outer_angle)
        shaping.CreateShapingConeSoftnessAttr(1.0 - light.inner_angle / light.outer_angle)
    if not directional and light.attenuation != (0.0, 0.0, 1.0):
        own = prim.GetPrim().CreateAttribute("warp_ar:attenuation", pxr.Sdf.ValueTypeNames.Double3)
        own.Set(pxr.Gf.Vec3d(*light.attenuation))
    _place(pxr, prim, dict(enumerate(key_frames(shot.light_placements(light)))))
