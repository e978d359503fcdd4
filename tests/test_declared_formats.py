"""Declarations of formats: what the page says is refused or named is fed to its reader, and refused or named."""

from __future__ import annotations

import base64
import dataclasses
import fractions
import io
import json
import pathlib
import struct
import sys
from typing import Any

import av
import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image, PngImagePlugin

from docs.tables import formats
from tests.gltf_files import SQUARE, SQUARE_FACES, SQUARE_UVS, Gltf
from tests.test_foreign_files import adobe_profile, photograph
from warp_ar.errors import SceneError, WarpArError
from warp_ar.exr_file import read_linear_picture
from warp_ar.scene import load_calibration
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.pose_file import load_pose_file
from warp_ar.sources.frame_folder import read_frame
from warp_ar.sources.video_file import VideoFile

NOT_HERE = {
    "axes taken": "test_linear_pictures",  # of lights, not of pictures
    "parts not taken": "test_linear_pictures",
    "deep pixels": "test_linear_pictures",  # written by OpenImageIO
    "frames without a pose": "test_pose_file",  # needs frames
    "animated …": "test_node_animation",
}
"""Features that other files of tests feed, by what is declared."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A feature of a format, a file that has it, and what is said."""

    declared: str
    """As the page's cell has it."""
    name: str
    """Of the file."""
    data: Any
    """Its bytes, text or tree of JSON."""
    said: str
    """Words of the error, the note or the line."""
    beside: tuple[tuple[str, Any], ...] = ()
    """Other files."""


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
WRAPPED = CORNERS + "vt 0 0\nvt 1 0\nvt 0 1\nmtllib a.mtl\nusemtl a\nf 1/1 2/2 3/3\n"
PNG = cv2.imencode(".png", np.full((2, 2, 3), 200, np.uint8))[1].tobytes()
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{}{}"
PLY_FACE = (
    "element face 1\nproperty list uchar int vertex_indices\n{}end_header\n0 0 0 {}\n1 0 0 {}\n0 1 0 {}\n3 0 1 2 {}\n"
)
STL = struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0x8000)
PINHOLE = {"image_width": 640, "image_height": 480, "camera_matrix": [[400, 0, 320], [0, 400, 240], [0, 0, 1]]}
HDR = "#?RADIANCE\n{}\n\n-Y 1 +X 8\n"


def ply(vertices: str = "", faces: str = "", more: str = "", of_faces: str = "", head: str = "") -> str:
    text = PLY.format(vertices, PLY_FACE.format(faces, more, more, more, of_faces))
    return text.replace("element vertex", f"{head}element vertex")


def library(declared: str, lines: str, said: str) -> Case:
    beside = (("a.mtl", f"newmtl a\n{lines}\n"), ("a.png", PNG))
    return Case(declared, "a.obj", WRAPPED, said, beside)


def hdr(declared: str, line: str, said: str) -> Case:
    pixels = bytes([128, 128, 128, 129]) * 8
    return Case(declared, "a.hdr", HDR.format(line).encode() + pixels, said)


def gltf(declared: str, said: str, primitive: dict[str, Any] | None = None, **tree: Any) -> Case:
    """A square; ``primitive``: more of its primitive, arrays as they are."""
    made = Gltf()
    places = made.array(SQUARE)
    given = dict(primitive or {})
    attributes = {name: made.array(values) for name, values in given.pop("attributes", {}).items()}
    mesh = {"attributes": {"POSITION": places, **attributes}, "indices": made.array(SQUARE_FACES), **given}
    other = given.pop("other", None)
    made.node({key: value for key, value in mesh.items() if key != "other"})
    if other is not None:
        made.tree["meshes"][0]["primitives"].append(other)
    made.tree.update(tree)
    made.tree["nodes"][0].update({"skin": 0} if "skins" in tree else {})
    return Case(declared, "a.glb", made, said)


def profiled() -> bytes:
    """A PNG of Adobe RGB."""
    data = io.BytesIO()
    Image.new("RGB", (2, 2), (160, 90, 47)).save(data, "PNG", icc_profile=adobe_profile())
    return data.getvalue()


def encoded(suffix: str, cicp: tuple[int, int] = (1, 13)) -> bytes:
    """A picture of noise; ``cicp``: primaries and transfer of a PNG."""
    data, said = io.BytesIO(), PngImagePlugin.PngInfo()
    said.add(b"cICP", bytes([*cicp, 0, 1]))
    picture = Image.fromarray(np.random.default_rng(1).integers(0, 255, (32, 32, 3), np.uint8))
    picture.save(data, Image.registered_extensions()[suffix], **({"pnginfo": said} if suffix == ".png" else {}))
    return data.getvalue()


def film(path: pathlib.Path, shape: int = 1) -> None:
    """Write a video of three frames whose pixels have a shape."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", 30)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuvj420p"
        stream.codec_context.sample_aspect_ratio = fractions.Fraction(shape)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((32, 32, 3), 90, np.uint8))))
        container.mux(stream.encode())


def open_video(path: pathlib.Path) -> Any:
    """Open a video; an AVI at no rate."""
    with VideoFile(path, fps=0.0 if path.suffix == ".avi" else None) as source:
        print(source.note, file=sys.stderr)


UV = {"attributes": {"TEXCOORD_0": SQUARE_UVS}, "material": 0}
IMAGE = {"images": [{"uri": "none.png"}], "textures": [{"source": 0}]}
MOVED = {"name": "a", "samplers": [], "channels": [{"target": {"node": 0, "path": "weights"}, "sampler": 0}]}

MTL_KEYS = "map_bump bump disp map_ns refl decal map_tr tf pc ps aniso map_ka map_emissive map_orm"
DAMAGED = "damaged"
"""Feature that the page says once of all formats."""
CASES: dict[str, list[Case]] = {
    "`.obj`": [
        Case("damaged", "a.obj", CORNERS + "f 1 2 9\n", "vertex index 8"),
        Case(
            "the material …, which no library has", "a.obj", WRAPPED, "material a, ", (("a.mtl", "newmtl b\nKd 1 0 0"),)
        ),
        Case("the material library …, which is not there", "a.obj", WRAPPED, "library a.mtl, which is not there"),
        *(
            Case("curv, curv2, surf, l, p, #MRGB", "a.obj", f"{CORNERS}f 1 2 3\n{key} 1 2\n", said)
            for key, said in (
                *(("curv", "free-form"), ("curv2", "free-form"), ("surf", "free-form")),
                *(("l", "lines"), ("p", "points and lines"), ("#MRGB", "ZBrush")),
            )
        ),
        Case(
            "smoothing groups without normals: edges of more than … degrees are sharp",
            "a.obj",
            f"{CORNERS}s 1\nf 1 2 3\n",
            "smoothing groups without normals",
        ),
        Case(
            "alpha of colours, which is 0 everywhere",
            "a.obj",
            "v 0 0 0 1 1 1 0\nv 1 0 0 1 1 1 0\nv 0 1 0 1 1 1 0\nf 1 2 3\n",
            "alpha of colours",
        ),
    ],
    "MTL": [
        library("damaged", "map_Kd a.mtl", "a.mtl, which it names"),
        library("maps of one material that are placed differently", "map_Kd a.png\nmap_d -s 2 2 1 a.png", "placed"),
        library("the option … of maps", "map_Kd -wild 3 a.png", "option -wild of maps"),
        library("-boost, -cc, -mm, -t", "map_Kd -boost 2 a.png", "-boost"),
        library("-boost, -cc, -mm, -t", "map_Kd -cc on a.png", "-cc"),
        library("-boost, -cc, -mm, -t", "map_Kd -mm 0.1 2 a.png", "-mm"),
        library("-boost, -cc, -mm, -t", "map_Kd -t 1 1 1 a.png", "-t"),
        *(
            library("the key … of materials", f"{key} 0.5 0.5 0.5", f"the key {key} of materials")
            for key in MTL_KEYS.split()
        ),
        library("-halo of d", "d -halo 0.5", "-halo of d"),
        *(
            library("the value … …, which is not … numbers", line, f"{line[:2].lower()}{line[2:]}, which is not")
            for line in ("Kd xyz 0.4 0.2 0.1", "Kd spectral a.rfl", "Ns 0,5", "Ke 1 2")
        ),
        library("a value of … beyond … to …", "Kd 204 102 51", "kd beyond 0 to 1"),
        library("a value of … beyond … to …", "d 2", "d beyond 0 to 1"),
    ],
    "`.ply`": [
        Case("damaged", "a.ply", ply()[:-12], "is the file whole"),
        Case(
            "the element …",
            "a.ply",
            ply().replace("end_header", "element edge 1\nproperty int vertex1\nend_header") + "0\n",
            "the element edge",
        ),
        Case("the property … of each …", "a.ply", ply("property float gloss\n", more="1"), "gloss of each vertex"),
        Case(
            "strips of triangles beside faces",
            "a.ply",
            ply().replace("end_header", "element tristrips 0\nproperty list uchar int vertex_indices\nend_header"),
            "strips of triangles beside faces",
        ),
        Case(
            "texture coordinates of faces that do not fit their corners",
            "a.ply",
            ply(faces="property list uchar float texcoord\n", of_faces="4 0 0 1 1"),
            "do not fit their corners",
        ),
        Case(
            "the texture …, which is not there",
            "a.ply",
            ply(
                faces="property list uchar float texcoord\n",
                of_faces="6 0 0 1 0 0 1",
                head="comment TextureFile none.png\n",
            ),
            "the texture none.png",
        ),
        Case(
            "alpha of colours, which is 0 everywhere",
            "a.ply",
            ply("".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha")), more="9 9 9 0"),
            "alpha of colours",
        ),
    ],
    "`.off`": [
        Case("damaged", "a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "cut off"),
        *(
            Case("BINARY, 4OFF, nOFF", "a.off", f"{head}\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "no OFF of text")
            for head in ("OFF BINARY", "4OFF", "nOFF")
        ),
        Case(
            "colours of faces by their number in a table",
            "a.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 7\n",
            "number in a table",
        ),
        Case(
            "alpha of colours, which is 0 everywhere",
            "a.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 9 9 9 0\n",
            "alpha of colours",
        ),
    ],
    "`.stl`": [
        Case("damaged", "a.stl", bytes(80) + STL[:40], "cut off"),
        Case(
            "damaged", "a.stl", b"solid a\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n", "in a facet"
        ),
        Case("colours of triangles", "a.stl", bytes(80) + STL, "colours of triangles"),
        Case("bytes behind the last triangle", "a.stl", bytes(80) + STL + bytes(80) + STL, "bytes behind"),
    ],
    "`.gltf` `.glb`": [
        Case("damaged", "a.glb", b"glTF", "cut off"),
        *(
            gltf("meshes compressed by Draco or meshopt", "compressed with", extensionsRequired=[name])
            for name in ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
        ),
        gltf("other extensions", "KHR_materials_sheen", extensionsUsed=["KHR_materials_sheen"]),
        gltf("animations (an object's key play names one)", "animations", animations=[MOVED]),
        gltf("damaged", "it is of glTF 1.0", asset={"version": "1.0"}),
        gltf("damaged", "it is of glTF 2.1", asset={"version": "2.0", "minVersion": "2.1"}),
        gltf(
            "factors beyond their ranges", "emissiveFactor beyond 0 to 1", UV, materials=[{"emissiveFactor": [2, 1, 0]}]
        ),
        gltf(
            "colours beyond the first set",
            "colours beyond",
            {"attributes": {name: np.ones((4, 4), np.float32) for name in ("COLOR_0", "COLOR_1")}},
        ),
        gltf(
            "colour profiles of pictures, which glTF has ignored",
            "colour profiles",
            UV,
            images=[{"uri": "data:image/png;base64," + base64.b64encode(profiled()).decode()}],
            textures=[{"source": 0}],
            materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        ),
        gltf("cameras", "cameras", cameras=[{"type": "perspective"}]),
        gltf("primitives without positions", "without positions", {"other": {"attributes": {}}}),
        gltf(
            "joints beyond four per vertex",
            "joints beyond four",
            {
                "attributes": {
                    **{name: np.zeros((4, 4), np.uint8) for name in ("JOINTS_0", "JOINTS_1")},
                    "WEIGHTS_0": np.full((4, 4), 0.25, np.float32),
                }
            },
            skins=[{"joints": [0]}],
        ),
        gltf("points and lines", "points and lines", {"other": {"attributes": {"POSITION": 0}, "mode": 1}}),
        gltf(
            "a texture in a format of an extension",
            "format of an extension",
            UV,
            textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}],
            materials=[{"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}],
        ),
        gltf(
            "texture coordinates beyond the second set",
            "beyond the second set",
            UV,
            **IMAGE,
            materials=[{"normalTexture": {"index": 0, "texCoord": 2}}],
        ),
    ],
    "`.exr` `.hdr`": [
        Case("damaged", "a.exr", b"\x76\x2f\x31\x01 cut", "cannot be read as OpenEXR"),
        Case("other channels", "a.exr", {"U": 1.0}, "has channels U"),
        hdr("HDR of CIE XYZ or a GAMMA", "FORMAT=32-bit_rle_xyze", "CIE XYZ"),
        hdr("HDR of CIE XYZ or a GAMMA", "GAMMA=2.2", "GAMMA 2.2"),
        hdr("EXPOSURE, COLORCORR", "EXPOSURE=2", "divided out"),
        hdr("EXPOSURE, COLORCORR", "COLORCORR=1 2 1", "divided out"),
        hdr("VIEW, PIXASPECT", "VIEW= -vtv", "not followed"),
        hdr("VIEW, PIXASPECT", "PIXASPECT=2", "not followed"),
        Case("values not finite (NaN: 0, infinity: 65,504)", "a.exr", {"Y": np.nan}, "are not finite"),
        *(
            Case("pixelAspectRatio, adoptedNeutral, another colorInteropID", "a.exr", {"Y": 0.5, key: value}, said)
            for key, value, said in (
                ("pixelAspectRatio", 2.0, "pixelAspectRatio"),
                ("adoptedNeutral", (0.3457, 0.3585), "adoptedNeutral"),
                ("colorInteropID", "srgb_rec709_scene", "srgb_rec709_scene is not followed"),
            )
        ),
    ],
    "pictures": [
        *(
            Case("damaged", f"a{suffix}", encoded(suffix)[:count], said)
            for suffix in (".png", ".jpg", ".tif", ".webp", ".bmp")
            for count, said in ((0, "is empty"), (10, "cannot be decoded"), (-200, "cannot be decoded"))
            if suffix != ".png" or count == 0
        ),
        Case("damaged", "a.png", encoded(".png")[:-200], "is cut off"),
        *(
            Case(
                "PNG of PQ or HLG",
                "a.png",
                encoded(".png", cicp=(9, transfer)),
                f"and transfer {transfer}; save it as SDR",
            )
            for transfer in (16, 18)
        ),
    ],
    "video": [
        Case(
            "damaged before its first frame", "a.mp4", b"\0\0\0\x18ftypisom" + bytes(200), "cannot be read as a video"
        ),
        Case("`fps` or one of `exposures` is not positive", "a.avi", lambda path: film(path), "fps"),
        Case("pixels made square", "a.mkv", lambda path: film(path, shape=2), "pixels of 2:1"),
    ],
    "EXIF": [
        Case("damaged", "a.jpg", encoded(".jpg")[:12], "cannot be decoded"),
        Case(
            "focal lengths that contradict each other (the 35 mm equivalent is taken)",
            "a.jpg",
            lambda path: photograph(path, (1200, 800), (1200, 800), 77),
            "contradicts itself",
        ),
    ],
    "calibrations": [
        Case("damaged", "a.json", "{", "cannot be read"),
        Case("missing keys", "a.json", {"image_width": 640, "image_height": 480}, "camera_matrix is missing"),
        Case("several cameras", "a.json", {"a": PINHOLE, "b": PINHOLE}, "holds 2 cameras"),
        Case("skew", "a.json", PINHOLE | {"camera_matrix": [[400, 5, 320], [0, 400, 240], [0, 0, 1]]}, "without skew"),
        Case("other models", "a.json", PINHOLE | {"distortion_model": "omni"}, "camera model 'omni'"),
        Case("other keys of distortion", "a.json", PINHOLE | {"distorsion_x": 0.1}, "distorsion_x: not understood"),
        Case(
            "cameras of single frames",
            "a.json",
            PINHOLE | {"fl_x": 400, "frames": [{"fl_x": 401}]},
            "fl_x of its own",
        ),
        Case(
            "wider fisheyes",
            "a.json",
            PINHOLE | {"image_width": 6400, "fisheye_model": 1, "distortion_coefficients": [0.0] * 4},
            "from its axis",
        ),
    ],
    "poses": [
        Case("damaged", "images.bin", b"\1" + bytes(7), "cut off"),
        Case("Alembic", "a.abc", b"", "Alembic is not read"),
        *(
            Case(
                "NeRF's applied_transform, applied_scale (the world behind them is taken)",
                "transforms.json",
                {"frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}], key: value},
                key,
            )
            for key, value in (("applied_transform", np.eye(4)[:3].tolist()), ("applied_scale", 2.0))
        ),
    ],
}


TABLE = formats().splitlines()


def declared() -> dict[str, set[str]]:
    """Features that the page's table declares as refused or named, by format."""
    found = {}
    for row in TABLE[2:]:
        name, _, refused, named = (cell.strip() for cell in row.strip("|").split("|"))
        found[name] = {feature for cell in (refused, named) for feature in cell.split("; ") if feature}
    return found


@pytest.mark.parametrize("name", CASES)
def test_every_declared_feature_has_a_case(name: str) -> None:
    fed = {case.declared for case in CASES[name]} - {DAMAGED}
    assert fed | (declared()[name] & NOT_HERE.keys()) == declared()[name]


def write(path: pathlib.Path, data: Any) -> None:
    if callable(data):
        data(path)
    elif isinstance(data, Gltf):
        data.save(path)
    elif isinstance(data, bytes):
        path.write_bytes(data)
    elif path.suffix == ".exr":
        planes = {name: np.full((4, 8), value, np.float32) for name, value in data.items() if len(name) == 1}
        told = {name: value for name, value in data.items() if len(name) > 1}
        OpenEXR.File({"type": OpenEXR.scanlineimage, **told}, planes).write(str(path))
    else:
        path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")


READERS = {
    "pictures": read_frame,
    "video": open_video,
    "EXIF": camera_by_exif,
    "`.exr` `.hdr`": lambda path: read_linear_picture(path, SceneError, str(path)),
    "calibrations": load_calibration,
    "poses": load_pose_file,
}


@pytest.mark.parametrize(
    ("name", "case"), [pytest.param(n, c, id=f"{n} {c.declared} {c.said}") for n, cases in CASES.items() for c in cases]
)
def test_what_is_declared_is_refused_or_named(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], name: str, case: Case
) -> None:
    for file, data in (*case.beside, (case.name, case.data)):
        write(tmp_path / file, data)
    refused = (
        case.declared == DAMAGED
        or case.declared in next(row for row in TABLE if row.startswith(f"| {name} ")).split(" | ")[2]
    )
    if refused:
        with pytest.raises(WarpArError) as told:
            READERS.get(name, load_mesh)(tmp_path / case.name)
        said = str(told.value)
        assert case.name in said or case.said == "fps"
    else:
        found = READERS.get(name, load_mesh)(tmp_path / case.name)
        said = " ".join(getattr(found, "notes", ())) + capsys.readouterr().err
    assert case.said in said
