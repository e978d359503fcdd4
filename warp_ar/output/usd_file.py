"""A shot as USD (``.usda``, ``.usdc``, ``.usd``): needs ``usd-core``, of the extra ``exchange``.

z is up and a unit is a metre. The camera's apertures carry its principal point and both focal lengths, so its frustum
is the pinhole of the frames; USD has no distortion (see ``stmap``). Proxies stand below ``/shot/proxies``, virtual
objects below ``/shot/objects``. A light's ``normalize`` makes its power independent of its size: a white surface that
faces a sphere light of intensity i at distance d has radiance i / (4 pi d^2), so i = 4 I for a radiant intensity I.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.files import write_whole
from warp_ar.output.shot import FILM_WIDTH, Body, Matrix, Shot, encode_texture, key_frames, texture_file
from warp_ar.scene.description import Light
from warp_ar.signature import PROGRAM

USD_SUFFIXES = (".usda", ".usdc", ".usd")

SUN_DEGREES = 0.53
"""Angle of a directional light: the sun's."""
_TENTHS = 10.0
"""Lengths of a camera's lens are told in tenths of the stage's unit."""


def load_usd() -> Any:
    """The modules of USD.

    Raises:
        UsageError: It is not installed.
    """
    try:
        import pxr.Gf
        import pxr.Sdf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdLux
        import pxr.UsdShade
        import pxr.Vt
    except ImportError as error:
        raise UsageError('USD files need usd-core; install it with pip install "warp-ar[exchange]"') from error
    return pxr


def write_usd(path: Path, shot: Shot) -> list[Path]:
    """Write a shot as USD; textures go beside it.

    Args:
        path: Ends in one of ``USD_SUFFIXES``.
        shot: What to tell.

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
        # The light of another place: a program that interpolates or chooses finds it, none adds it to the first.
        prim = _write_dome(pxr, stage, f"/shot/lights/environment_{ball}", file)
        prim.SetCustomDataByKey("at", pxr.Gf.Vec3d(*at))
        prim.SetActive(False)
    try:
        write_whole(path, lambda part: _export(stage, part, path.suffix))
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    return written


def _write_dome(pxr: Any, stage: Any, path: str, file: Path) -> Any:
    """The light of an environment; returns its prim."""
    dome = pxr.UsdLux.DomeLight.Define(stage, path)
    dome.CreateIntensityAttr(1.0)
    dome.CreateTextureFileAttr(f"./{file.name}")
    dome.CreateTextureFormatAttr(pxr.UsdLux.Tokens.latlong)
    # A dome's pole is its own y.
    dome.AddRotateXOp().Set(90.0)
    return dome.GetPrim()


def _export(stage: Any, part: Path, suffix: str) -> None:
    """Write to a name that has the right ending, which tells the format, then to the one that is asked for."""
    named = part.with_name(part.name + suffix)
    try:
        if not stage.GetRootLayer().Export(str(named)):
            raise OSError(f"USD cannot write {named}")
        part.write_bytes(named.read_bytes())
    finally:
        named.unlink(missing_ok=True)


def _place(pxr: Any, prim: Any, placements: dict[int, Matrix]) -> None:
    """Give a prim its transform, by frame; USD's matrices map rows."""
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
    # Where the middle of the picture looks; its pixels have their centres at integers, and y is up.
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
    prim.CreateDoubleSidedAttr(True)
    if mesh.uvs is not None:
        coordinates = pxr.UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
            "st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.vertex
        )
        coordinates.Set(pxr.Vt.Vec2fArray.FromNumpy(mesh.uvs))
    prim.GetPrim().CreateAttribute("warp_ar:proxy", pxr.Sdf.ValueTypeNames.Bool).Set(body.proxy)
    _place(pxr, prim, dict(enumerate(key_frames(body.placements))))
    return _write_look(pxr, stage, body, prim, path)


def _write_look(pxr: Any, stage: Any, body: Body, prim: Any, path: Path) -> list[Path]:
    """The material, as UsdPreviewSurface; its texture goes beside the file."""
    sdf, look = pxr.Sdf.ValueTypeNames, body.look
    where = f"/shot/materials/{body.name}"
    material = pxr.UsdShade.Material.Define(stage, where)
    shader = pxr.UsdShade.Shader.Define(stage, f"{where}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", sdf.Float).Set(look.roughness)
    shader.CreateInput("metallic", sdf.Float).Set(look.metallic)
    if look.specular is not None:
        shader.CreateInput("useSpecularWorkflow", sdf.Int).Set(1)
        shader.CreateInput("specularColor", sdf.Color3f).Set(pxr.Gf.Vec3f(*look.specular))
    written = []
    colors = [("diffuseColor", "texture", look.base_color, look.texture, texture_file(path, body.name))]
    if any(look.emission):
        own = texture_file(path, body.name, "emission")
        colors.append(("emissiveColor", "emission", look.emission, look.glow, own))
    for name, node, factor, values, picture in colors:
        color = shader.CreateInput(name, sdf.Color3f)
        if values is None or body.mesh.uvs is None:
            color.Set(pxr.Gf.Vec3f(*factor))
            continue
        try:
            write_whole(picture, encode_texture(values))
        except OSError as error:
            raise SinkError(f"{picture} cannot be written: {reason(error)}") from error
        written.append(picture)
        texture = _texture(pxr, stage, where, node, picture)
        texture.CreateInput("scale", sdf.Float4).Set(pxr.Gf.Vec4f(*factor, 1.0))
        color.ConnectToSource(texture.CreateOutput("rgb", sdf.Float3))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    pxr.UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    return written


def _texture(pxr: Any, stage: Any, where: str, name: str, picture: Path) -> Any:
    """A picture, read by the texture coordinates ``st``."""
    sdf = pxr.Sdf.ValueTypeNames
    reader = pxr.UsdShade.Shader.Define(stage, f"{where}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", sdf.String).Set("st")
    texture = pxr.UsdShade.Shader.Define(stage, f"{where}/{name}")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", sdf.Asset).Set(f"./{picture.name}")
    texture.CreateInput("sourceColorSpace", sdf.Token).Set("sRGB")
    texture.CreateInput("wrapS", sdf.Token).Set("repeat")
    texture.CreateInput("wrapT", sdf.Token).Set("repeat")
    texture.CreateInput("st", sdf.Float2).ConnectToSource(reader.CreateOutput("result", sdf.Float2))
    return texture


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
