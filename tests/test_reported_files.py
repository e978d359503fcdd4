"""Small files that users of other tools met, each with the value that is right: one test or more for every one."""

from __future__ import annotations

import json
import pathlib
import struct

import numpy as np
import pytest
from PIL import Image

from warp_ar import environment, scenes
from warp_ar.light.captured import Light
from warp_ar.light.latlong_axes import from_axes
from warp_ar.output.environment_file import read_environment
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.pose_file import load_pose_file
from warp_ar.scene.textures import decode_rgba
from warp_ar.sources.frame_folder import read_frame
from warp_ar.sources.sources import open_source

CLIPS = pathlib.Path(scenes.__file__).parent / "clips"
CODED = 4.0
"""Mean difference in codes of a clip that was coded anew."""


@pytest.fixture
def cases(shared: pathlib.Path) -> pathlib.Path:
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip("needs ../shared/cases")
    return folder


def test_environment_exr_nan_window(cases: pathlib.Path, tmp_path: pathlib.Path) -> None:
    folder, out = cases / "environment_exr_nan_window", tmp_path / "x.json"
    assert environment.main([str(folder / "nan.exr"), "--output", str(out)]) == 0
    json.loads(out.read_text(), parse_constant=lambda word: pytest.fail(word))
    cropped = read_environment(folder / "cropped_window.exr")
    assert cropped.shape == (8, 16, 3)
    assert not cropped[[0, 1, 6, 7]].any()
    assert cropped[2:6].any()


def test_light_exr_axes(cases: pathlib.Path) -> None:
    path = cases / "light_exr_axes" / "envmap_latlong.exr"
    np.testing.assert_array_equal(Light.load(path).radiance, from_axes(Light.load(path, "z-up").radiance, "y-up"))


def test_light_exr_chromaticities(cases: pathlib.Path) -> None:
    found = Light.load(cases / "light_exr_chromaticities" / "own_acescg.exr").radiance
    # The file's AP1 has five digits.
    np.testing.assert_allclose(found.reshape(-1, 3).max(0), (1.0, 0.0, 0.0), atol=2e-4)


def areas(mesh: Mesh) -> np.ndarray:
    """Signed areas of the triangles of a mesh in the x, y plane."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return np.cross(b - a, c - a)[:, 2] / 2


@pytest.mark.parametrize("name", ["c.off", "face.off"])
def test_colours_of_an_off(cases: pathlib.Path, name: str) -> None:
    mesh = load_mesh(cases / "mesh_colours_lost" / name)
    # sRGB's 188 is 0.5029 of the light.
    np.testing.assert_allclose(mesh.colors[:, :3], [(0.5029, 0.0, 1.0)] * 3, atol=1e-4)


def test_vertex_colours_beside_a_material(cases: pathlib.Path) -> None:
    mesh = load_mesh(cases / "mesh_colours_lost" / "vcm2.obj")
    np.testing.assert_allclose(mesh.colors[:, :3], [(0.21404, 0.0, 1.0)] * 3, atol=1e-5)
    assert mesh.materials[0].surface.base_color == (1.0, 1.0, 1.0)


def test_an_stl_in_capitals_and_a_ply_with_lists_of_texture_coordinates(cases: pathlib.Path) -> None:
    assert areas(load_mesh(cases / "mesh_colours_lost" / "upper.stl")) == pytest.approx([0.5])
    mesh = load_mesh(cases / "mesh_colours_lost" / "wedge_quad.ply")
    assert areas(mesh) == pytest.approx([0.5, 0.5, 0.5])
    assert mesh.materials[0].base is not None
    corners = {(*mesh.vertices[v, :2].tolist(), *mesh.uvs[v].tolist()) for v in mesh.faces.ravel()}
    assert {(0, 0, 0, 0), (1, 0, 1, 0), (1, 1, 1, 1), (0, 1, 0, 1), (1, 0, 0, 0), (2, 0, 1, 0), (1, 1, 0, 1)} == corners


def test_a_concave_polygon_keeps_its_area(cases: pathlib.Path) -> None:
    found = areas(load_mesh(cases / "mesh_concave_polygons" / "concave.obj"))
    assert found.sum() == pytest.approx(2.5)
    assert (found > 0).all()


def test_material_libraries_with_a_mark_and_two_of_them(cases: pathlib.Path) -> None:
    folder = cases / "obj_material_libraries"
    colors = {
        name: [item.surface.base_color for item in load_mesh(folder / name).materials]
        for name in ("bom.obj", "two.obj")
    }
    assert colors == {"bom.obj": [(1, 0, 0)], "two.obj": [(1, 0, 0), (0, 1, 0)]}


@pytest.mark.parametrize("depth", [1, 2, 4, 8, 16])
def test_a_transparent_grey_of_a_png(depth: int) -> None:
    import io
    import zlib

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    white = (1 << depth) - 1
    rows = [
        int(f"{0:0{depth}b}{white:0{depth}b}".ljust(-(-2 * depth // 8) * 8, "0"), 2).to_bytes(-(-2 * depth // 8), "big")
    ]
    header = struct.pack(">IIBBBBB", 2, 1, depth, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"tRNS", struct.pack(">H", white))
    data += chunk(b"IDAT", zlib.compress(b"\0" + rows[0])) + chunk(b"IEND", b"")
    found = decode_rgba(data, "a.png")
    assert found.tolist() == [[[0, 0, 0, 255], [255, 255, 255, 0]]]
    if depth == 8:
        assert found.tolist() == np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).tolist()


def test_texture_grey_trns(cases: pathlib.Path) -> None:
    path = cases / "texture_grey_trns" / "grey_trns.png"
    expected = np.asarray(Image.open(path).convert("RGBA"))
    np.testing.assert_array_equal(decode_rgba(path.read_bytes(), "a.png"), expected)
    assert (expected[..., 3] == 0).any()


def test_hidden_files_are_no_frames(cases: pathlib.Path) -> None:
    with open_source(cases / "appledouble" / "frames") as source:
        assert len(list(source)) == 3


def test_profile_of_a_camera(cases: pathlib.Path) -> None:
    image = read_frame(cases / "icc_profiles" / "adobe.jpg")[0].astype(int)
    for column, right in ((10, (180, 90, 40)), (32, (60, 80, 170))):
        assert np.abs(image[8, column] - right).max() <= 3  # of JPEG


@pytest.mark.parametrize(("name", "right"), [("u16_planar.tif", (200, 120, 60)), ("f32_grey.tif", (200, 200, 200))])
def test_tiffs_in_planes_and_of_floats(cases: pathlib.Path, name: str, right: tuple[int, ...]) -> None:
    plate = read_frame(cases / "tiff_planar_and_float" / name)[1]
    most = 65535.0 if plate.picture.dtype == np.uint16 else 1.0
    np.testing.assert_allclose(plate.picture[0, 0] / most, np.array(right) / 255, atol=1e-4)


def test_focal_length_of_tags_that_contradict_each_other(cases: pathlib.Path) -> None:
    assert camera_by_exif(cases / "exif_focal_length" / "resized_tags_rewritten.jpg").fx == pytest.approx(
        2553, rel=0.01
    )


@pytest.mark.parametrize(
    ("name", "right"), [("opencv_fisheye_model.yml", (496.2, 345.7)), ("unknown_distortion_key.json", (501.9, 349.1))]
)
def test_calibrations_of_a_case(cases: pathlib.Path, name: str, right: tuple[float, float]) -> None:
    camera = load_calibration(cases / "calibration_fisheye" / name)
    assert project(camera, np.array([[0.5, 0.3, 1.0]]))[0] == pytest.approx(right, abs=0.07)


def test_videos_as_their_containers_present_them(cases: pathlib.Path) -> None:
    with open_source(cases / "video_mirror_matrix" / "hflip.mp4") as source:
        first = next(iter(source)).image
    assert first[10, -10].tolist() == pytest.approx([254, 0, 0], abs=4)
    with open_source(cases / "video_times_and_pixel_shape" / "vfr.mp4") as source:
        times = [round(1000 * frame.time) for frame in source]
    assert times == [0, 33, 66, 100, 600, 633, 666, 700, 1200, 1233, 1266, 1300]


def test_a_clip_whose_matrix_undoes_a_mirror_is_the_desk(cases: pathlib.Path) -> None:
    with open_source(cases / "video_mirror_matrix" / "unmirror.mp4") as source:
        shown = next(iter(source)).image.astype(float)
    with open_source(CLIPS / "desk.mp4") as source:
        desk = next(iter(source)).image.astype(float)
    assert shown.shape == desk.shape
    assert np.abs(shown - desk).mean() < CODED < np.abs(shown[:, ::-1] - desk).mean()


def test_poses_of_unpadded_names(cases: pathlib.Path) -> None:
    """Each picture has the translation that stands in the line of its name."""
    folder = cases / "poses_by_name"
    lines = [line.split() for line in (folder / "unpadded.txt").read_text().splitlines()]
    told = {words[9]: list(map(float, words[5:8])) for words in lines if len(words) == 10}
    poses = load_pose_file(folder / "unpadded.txt")
    found = {
        path.name: poses.at(number, path.as_posix())[1].tolist()
        for number, path in enumerate(sorted((folder / "f").iterdir()))
    }
    assert found == told
    assert len({tuple(place) for place in told.values()}) == 12
