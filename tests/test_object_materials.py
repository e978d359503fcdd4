"""Objects with their files' materials as rays meet them: surfaces, what lets rays pass, where normals point."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
import pytest
import trimesh
import warp as wp
from PIL import Image

from tests.gltf_files import SQUARE_UVS, Gltf
from tests.test_foreign_files import adobe_profile, as_srgb
from tests.twins import prefilter as reference
from warp_ar.errors import SceneError
from warp_ar.kernels.materials import make_surface
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, PHONG, RayScene
from warp_ar.scene import Camera, LambertMaterial, Object, PhongMaterial, Scene, dumps_scene, object_from_trimesh
from warp_ar.scene.mesh_files import load_mesh, mesh_from_trimesh
from warp_ar.scene.ray_scene import HostScene

CAMERA = Camera(width=64, height=48, fx=600.0, fy=620.0, cx=30.5, cy=24.0)
DETAIL = TraceConfig((0,), ()).general()
trace = make_trace(dataclasses.replace(DETAIL, detail=True, stretched=True))
closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
surface_at = make_surface((LAMBERT, PHONG, METALLIC_ROUGHNESS), True)
# Codes of 8 bits come back as they are; a few float32 products on the way.
FLOAT_TOLERANCE = 2e-6


@wp.struct
class Seen:
    """What a ray finds."""

    t: wp.float32
    normal: wp.vec3
    hidden: wp.int32
    diffuse: wp.vec3
    f0: wp.vec3
    roughness: wp.float32
    emission: wp.vec3
    occlusion: wp.float32


@wp.kernel(enable_backward=False, module="unique")
def look_kernel(
    # In:
    scene: RayScene,
    dfg: wp.array2d[wp.vec2],
    origins: wp.array[wp.vec3],
    direction: wp.vec3,
    # Out:
    seen_out: wp.array[Seen],
):
    i = wp.tid()
    seen = Seen()
    hit = closest_object(scene, origins[i], direction, FAR)
    seen.t = hit.t
    if occluded_by_objects(scene, origins[i], direction, FAR):
        seen.hidden = 1
    if hit.shape >= 0:
        seen.normal = hit.normal
        surface = surface_at(scene, dfg, hit, 1.0, 0.0)
        seen.diffuse = surface.diffuse
        seen.f0 = surface.f0
        seen.roughness = surface.roughness
        seen.emission = surface.emission
        seen.occlusion = surface.occlusion
    seen_out[i] = seen


def look(objects, origins, direction, device):
    """What rays along a direction find of virtual objects."""
    host = HostScene(Scene(CAMERA, objects=tuple(objects)), wp.get_device(device))
    table = wp.zeros((32, 32), dtype=wp.vec2, device=device)
    integrate_dfg(table)
    seen = wp.zeros(len(origins), dtype=Seen, device=device)
    starts = wp.array(np.asarray(origins, np.float32), dtype=wp.vec3, device=device)
    inputs = [host.ray_scene, table, starts, wp.vec3(*direction)]
    wp.launch(look_kernel, dim=len(origins), inputs=inputs, outputs=[seen], device=device)
    return seen.numpy()


def directional_albedo(roughness, device):
    """What a facet that reflects all gives at normal incidence after one scattering, by roughness, (n, 1)."""
    table = wp.zeros((32, 32), dtype=wp.vec2, device=device)
    integrate_dfg(table)
    return np.interp(roughness, np.linspace(0.0, 1.0, 32), table.numpy()[:, -1].sum(axis=-1))[:, None]


def square(tmp_path: pathlib.Path, *, uvs=None, **material) -> pathlib.Path:
    """An upright square around the origin, seen along +y."""
    made = Gltf()
    textures = {"baseColorTexture", "metallicRoughnessTexture"}
    own = {key: value for key, value in material.items() if key not in textures}
    reflection = own.setdefault("pbrMetallicRoughness", {})
    for key in textures & set(material):
        reflection[key] = material[key](made)
    own = {key: value(made) if callable(value) else value for key, value in own.items()}
    made.material(**own)
    attributes = {} if uvs is None else {"TEXCOORD_0": made.array(np.float32(uvs))}
    made.node(made.square(0, **attributes))
    return made.save(tmp_path / "square.glb")


def grid(count: int = 16, y: float = -3.0):
    """Origins of rays before the square, one in the middle of each texel of a picture so large."""
    at = (np.arange(count) + 0.5) / count * 2.0 - 1.0
    x, z = np.meshgrid(at, at[::-1])
    return np.stack([x, np.full_like(x, y), z], axis=-1).reshape(-1, 3)


FORWARD = (0.0, 1.0, 0.0)


def picture(seed=1, channels=4):
    return np.random.default_rng(seed).integers(0, 256, (16, 16, channels)).astype(np.uint8)


def test_every_texture_reaches_the_surface(device, tmp_path):
    """A ray through each texel's middle finds the products of factors and texels, of the right channels."""
    base, factors, occlusion, glow = (picture(seed, 3) for seed in range(4))
    path = square(
        tmp_path,
        baseColorTexture=lambda made: {"index": made.texture(base)},
        metallicRoughnessTexture=lambda made: {"index": made.texture(factors)},
        pbrMetallicRoughness={"baseColorFactor": [0.5, 0.6, 0.7, 1.0], "metallicFactor": 1.0, "roughnessFactor": 0.5},
        occlusionTexture=lambda made: {"index": made.texture(occlusion), "strength": 0.5},
        emissiveTexture=lambda made: {"index": made.texture(glow)},
        emissiveFactor=[0.25, 0.5, 1.0],
    )
    seen = look([Object("mesh", file=path)], grid(), FORWARD, device)

    def srgb(codes):
        x = codes.reshape(-1, 3) / 255.0
        return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)

    metallic = factors.reshape(-1, 3)[:, 2:] / 255.0
    color = srgb(base) * [0.5, 0.6, 0.7]
    facets = np.stack([np.full_like(color, 0.04), color])
    gains = reference.energy_compensation(directional_albedo(seen["roughness"], device), facets)
    mixed = 0.04 * (1 - metallic) * gains[0] + metallic * color * gains[1]
    np.testing.assert_allclose(seen["f0"], mixed, atol=FLOAT_TOLERANCE)
    np.testing.assert_allclose(seen["roughness"], 0.5 * factors.reshape(-1, 3)[:, 1] / 255.0, atol=FLOAT_TOLERANCE)
    np.testing.assert_allclose(
        seen["occlusion"], 0.5 + 0.5 * occlusion.reshape(-1, 3)[:, 0] / 255, atol=FLOAT_TOLERANCE
    )
    np.testing.assert_allclose(seen["emission"], srgb(glow) * [0.25, 0.5, 1.0], atol=FLOAT_TOLERANCE)


def test_normal_maps_tilt_the_normal(device, tmp_path):
    """Texels of a flat map tilt the normal in the frame of the picture, also where the picture is mirrored."""
    turned = np.full((16, 16, 3), (128 + 60, 128 + 30, 128 + 90), np.uint8)
    x, y, z = (turned[0, 0] / 255.0 * 2.0 - 1.0) * [0.5, 0.5, 1.0]
    for mirrored in (False, True):
        uvs = SQUARE_UVS * [-1.0, 1.0] + [1.0, 0.0] if mirrored else SQUARE_UVS
        path = square(tmp_path, uvs=uvs, normalTexture=lambda made: {"index": made.texture(turned), "scale": 0.5})
        seen = look([Object("mesh", file=path)], grid(4), FORWARD, device)
        # In the world the picture's right is x (or -x), its up is z, and the surface faces -y.
        expected = np.array([-x if mirrored else x, -z, y]) / np.linalg.norm([x, y, z])
        np.testing.assert_allclose(seen["normal"], np.tile(expected, (16, 1)), atol=1e-5)


DEGENERATE = {
    "none": None,
    "one point": np.full_like(SQUARE_UVS, 0.25),
    "one line": SQUARE_UVS * [1.0, 0.0],
    "huge": SQUARE_UVS * 1e6,
    "far": SQUARE_UVS + 1e7,
}


@pytest.mark.parametrize("uvs", DEGENERATE.values(), ids=DEGENERATE)
@pytest.mark.parametrize("direction", [FORWARD, (0.0, 1e-3, 1.0)], ids=["ahead", "grazing"])
def test_textures_at_their_ends(device, tmp_path, uvs, direction):
    """No roughness, a normal map that lies flat, alpha, and coordinates that span no picture: numbers, unit normals."""
    flat = np.full((16, 16, 3), (255, 128, 128), np.uint8)
    path = square(
        tmp_path,
        uvs=DEGENERATE["one point"] if uvs is None else uvs,
        baseColorTexture=lambda made: {"index": made.texture(picture(2))},
        metallicRoughnessTexture=lambda made: {"index": made.texture(np.zeros((16, 16, 3), np.uint8))},
        normalTexture=lambda made: {"index": made.texture(flat)},
        alphaMode="MASK",
        doubleSided=True,
    )
    origins = grid(8) if direction == FORWARD else grid(8) * [1.0, 0.0, 0.0] + [0.0, -1e-3, -1.0]
    seen = look([Object("mesh", file=path)], origins, direction, device)
    met = seen["t"] < 1e3
    for name in ("diffuse", "f0", "roughness", "emission", "occlusion", "normal"):
        assert np.isfinite(seen[name]).all(), name
    np.testing.assert_allclose(np.linalg.norm(seen["normal"][met], axis=1), 1.0, atol=1e-5)
    assert (seen["roughness"] == 0.0).all()


def test_masks_let_rays_pass(device, tmp_path):
    """What lies behind a hole is seen, and lit through it; a masked texel is neither."""
    alpha = picture(5)
    path = square(
        tmp_path, baseColorTexture=lambda made: {"index": made.texture(alpha)}, alphaMode="MASK", alphaCutoff=0.5
    )
    front, back = Object("mesh", file=path), Object("box", size=(0.4, 0.4, 0.4), at=(0.0, 3.0, 0.0))
    there = alpha[..., 3].ravel() >= 128
    seen = look([front], grid(), FORWARD, device)
    np.testing.assert_array_equal(seen["t"] < FAR, there)
    np.testing.assert_array_equal(seen["hidden"] == 1, there)
    seen = look([front, back], grid(), FORWARD, device)
    at = grid()
    behind = (np.abs(at[:, [0, 2]]) < 0.2).all(axis=1)
    np.testing.assert_array_equal(seen["t"] < FAR, there | behind)
    np.testing.assert_allclose(seen["t"][there], 3.0, rtol=1e-5)
    assert (~there & behind).any()


def test_blending_shows_its_share(device, tmp_path):
    """Of many rays as many are held up as alpha says, within five standard errors; again the same ones."""
    for opacity in (0.0, 0.3, 0.8, 1.0):
        path = square(tmp_path, pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, opacity]}, alphaMode="BLEND")
        seen = look([Object("mesh", file=path)], grid(100), FORWARD, device)
        share = float((seen["t"] < FAR).mean())
        error = np.sqrt(opacity * (1.0 - opacity) / len(seen))
        assert abs(share - opacity) <= 5.0 * error
        again = look([Object("mesh", file=path)], grid(100), FORWARD, device)
        np.testing.assert_array_equal(seen["t"], again["t"])


@pytest.mark.parametrize("double", [False, True])
def test_a_sheet_seen_from_behind(device, tmp_path, double):
    """A sheet of one side is not there from behind, but throws a shadow; one of two sides is."""
    path = square(tmp_path, doubleSided=double)
    seen = look([Object("mesh", file=path)], grid(4, y=3.0), (0.0, -1.0, 0.0), device)
    assert ((seen["t"] < FAR) == double).all()
    assert (seen["hidden"] == 1).all()
    front = look([Object("mesh", file=path)], grid(4), FORWARD, device)
    assert (front["t"] < FAR).all()


def test_objects_share_a_mesh_but_not_materials(device, tmp_path):
    """Two objects of one file with two materials, one of them with another of the scene's."""
    made = Gltf()
    red, green = (made.material(emissiveFactor=color, doubleSided=True) for color in ([1, 0, 0], [0, 1, 0]))
    made.node(made.square(red))
    made.node(made.square(green), translation=[3, 0, 0])
    path = made.save(tmp_path / "two.glb")
    chalk = LambertMaterial((0.1, 0.2, 0.3))
    objects = [Object("mesh", file=path), Object("mesh", file=path, at=(0.0, 0.0, 5.0), material=chalk)]
    seen = look(objects, [(0, -3, 0), (3, -3, 0), (0, -3, 5), (3, -3, 5)], FORWARD, device)
    np.testing.assert_allclose(seen["emission"], [[1, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(seen["diffuse"][2:], np.tile(np.float32([0.1, 0.2, 0.3]), (2, 1)))


def test_material_libraries(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl shiny\nf 1 2 3\nusemtl matt\nf 3 2 1\n")
    (tmp_path / "a.mtl").write_text(
        "newmtl shiny\nKd 0.5 0.25 0.125\nKs 0.2 0.2 0.2\nNs 40\nd 0.5\nbump b.png\n"
        "newmtl matt\nKd 0.9 0.9 0.9\nKe 3 2 1\nillum 1\n"
    )
    mesh = load_mesh(path)
    shiny, matt = (next(item for item in mesh.materials if item.name == name) for name in ("shiny", "matt"))
    assert shiny.surface == PhongMaterial((0.5, 0.25, 0.125), (0.2, 0.2, 0.2), 40.0)
    assert (shiny.alpha, shiny.opacity) == ("blend", 0.5)
    assert (matt.surface, matt.emission) == (LambertMaterial((0.9, 0.9, 0.9)), (3.0, 2.0, 1.0))
    assert mesh.notes == ("the key bump of materials",)
    (tmp_path / "a.mtl").write_text("newmtl shiny\nKd 1 1 1\nPr 0.2\nPm 1\nnewmtl matt\nmap_Ke none.png\n")
    with pytest.raises(SceneError, match=r"none\.png, which it names, is not there"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("options", "placed", "wrap", "notes"),
    [
        ("", (1, 0, 0, 0, 1, 0), "repeat", ()),
        ("-s 2 3 1 -o 0.25 0.5 0", (2, 0, 0.25, 0, 3, 0.5), "repeat", ()),
        ("-blendu on -s 2 -O 0.25 -clamp on", (2, 0, 0.25, 0, 1, 0), "clamp", ()),
        ("-texres 512 -mm 0 1 -t 0 0 0 -cc off", (1, 0, 0, 0, 1, 0), "repeat", ()),
        ("-mm 0.1 2 -t 1 1 1", (1, 0, 0, 0, 1, 0), "repeat", ("ranges of maps (-mm)", "turbulence of maps (-t)")),
        ("-shine 3", (1, 0, 0, 0, 1, 0), "repeat", ("the option -shine of maps",)),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_options_of_maps_are_followed_or_named(tmp_path, options, placed, wrap, notes, first):
    Image.fromarray(picture(channels=3)).save(tmp_path / "a map 2.png")
    words = f"{options} a map 2.png" if first or "-shine" in options else f"a map 2.png {options}"
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "a.mtl").write_text(f"newmtl a\nmap_Kd {words}\nmap_Pr -imfchan b {words}\nnorm -bm 0.5 {words}\n")
    mesh = load_mesh(tmp_path / "a.obj")
    (material,) = mesh.materials
    for use in (material.base, material.metallic_roughness, material.normal):
        assert (use.transform, use.wrap) == (placed, (wrap, wrap))
    np.testing.assert_array_equal(mesh.images[material.metallic_roughness.image][..., 1], picture(channels=3)[..., 2])
    assert (material.normal_scale, mesh.notes) == (0.5, notes)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_profiles_of_colour_maps_are_followed(tmp_path, suffix):
    """Those of maps of numbers are not."""
    codes = np.full((4, 4, 3), (160, 90, 47), np.uint8)
    Image.fromarray(codes).save(tmp_path / "a.png", icc_profile=adobe_profile())
    path = tmp_path / f"a{suffix}"
    if suffix == ".obj":
        path.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")
        (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd a.png\nnorm a.png\n")
    else:
        head = (
            "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        )
        head += "property float z\nproperty float s\nproperty float t\nelement face 1\n"
        head += "property list uchar int vertex_indices\nend_header\n"
        path.write_text(head + "0 0 0 0 0\n1 0 0 0 0\n0 1 0 0 0\n3 0 1 2\n")
    mesh = load_mesh(path)
    (material,) = mesh.materials
    assert np.abs(mesh.images[material.base.image][0, 0, :3] - as_srgb(codes[0, 0])).max() <= 2
    if material.normal is not None:
        np.testing.assert_array_equal(mesh.images[material.normal.image][..., :3], codes)


def test_numbers_that_are_not_finite_are_named_and_nothing_else_is_said(tmp_path):
    """In every format, whatever the reader computes of them first: a warning would be an error here."""
    corners = "vertex 0 0 0\nvertex 1 0 inf\nvertex 0 1 0"
    texts = {
        "a.stl": f"solid x\nfacet normal 0 0 1\nouter loop\n{corners}\nendloop\nendfacet\nendsolid\n",
        "a.obj": "v 0 0 0\nv 1 0 inf\nv 0 1 0\nf 1 2 3\n",
        "a.off": "OFF\n3 1 0\n0 0 0\n1 0 inf\n0 1 0\n3 0 1 2\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(SceneError, match=r"vertex 1 is \[1.0, 0.0, inf\]"):
            load_mesh(tmp_path / name)


def test_balls_of_drawing_formats_are_round(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.export(tmp_path / "ball.stl")
    mesh = load_mesh(tmp_path / "ball.stl")
    assert (mesh.vertices * mesh.normals).sum(axis=1).min() > 0.999


def test_meshes_in_memory(device, tmp_path):
    """A Trimesh is an object as it is; a scene file cannot say it."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.visual.vertex_colors = [0, 255, 0, 255]
    item = object_from_trimesh(ball, at=(0.0, 1.0, 0.0))
    seen = look([item], [(0, -3, 0)], FORWARD, device)
    assert seen["t"][0] == pytest.approx(3.5, abs=0.01)
    np.testing.assert_allclose(seen["diffuse"][0], [0, 1, 0], atol=1e-6)
    block = trimesh.creation.box()
    block.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.SimpleMaterial(diffuse=[255, 0, 0]))
    posts = mesh_from_trimesh(trimesh.Scene([block, trimesh.creation.cylinder(0.1, 3.0)]))
    assert np.ptp(posts.vertices, axis=0) == pytest.approx([1.0, 1.0, 3.0])
    assert [part.surface.base_color for part in posts.materials] == [(1.0, 0.0, 0.0), (0.8, 0.8, 0.8)]
    assert posts.materials[0].surface.metallic == 0.0
    painted = trimesh.creation.box()
    painted.visual.face_colors = [[20 * face, 0, 0, 255] for face in range(12)]
    assert len(np.unique(mesh_from_trimesh(painted).colors, axis=0)) == 12
    with pytest.raises(SceneError, match="a mesh in memory cannot be written"):
        dumps_scene(Scene(CAMERA, objects=(item,)))
    with pytest.raises(SceneError, match=r"a mesh is str; a trimesh\.Trimesh"):
        mesh_from_trimesh("ball.ply")
    with pytest.raises(SceneError, match="no triangle"):
        mesh_from_trimesh(trimesh.Trimesh())
