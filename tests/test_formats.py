"""The table of formats: every row has its tests, every ending that the code takes has its row."""

from __future__ import annotations

import ast
import pathlib
import re

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh

import warp_ar
from docs.tables import READERS, formats
from tests.test_sources import write_video
from warp_ar.kernels.color import decode_table
from warp_ar.output.camera_files import TRACK_SUFFIX
from warp_ar.output.environment_file import ENVIRONMENT_SUFFIXES
from warp_ar.output.gltf_file import GLTF_SUFFIX
from warp_ar.output.usd_file import USD_SUFFIXES
from warp_ar.output.video_sink import VIDEO_SUFFIXES
from warp_ar.scene.mesh_files import MESH_SUFFIXES, load_mesh
from warp_ar.sources.frame_folder import IMAGE_SUFFIXES, LINEAR_SUFFIX
from warp_ar.sources.sources import open_source

ROOT = pathlib.Path(warp_ar.__file__).parents[1]
PAGE = ROOT / "docs" / "formats.md"
LOSSY = 12  # codes by which a smooth picture changes in JPEG or WebP of OpenCV's default quality, or in video


TESTS = {
    ("In", "frames"): """
        test_formats::test_pictures_of_every_ending_are_frames
        test_foreign_files::test_a_frame_with_a_profile_is_read_in_srgb
        test_foreign_files::test_any_tiff_is_read
        test_deep_frames::test_pictures_of_16_bits_keep_their_codes
        test_deep_frames::test_openexr_is_light
        test_sources::test_exposures_come_from_the_sidecar
    """,
    ("In", "video"): """
        test_formats::test_videos_of_every_ending_are_frames
        test_sources::test_frames_that_an_edit_list_leaves_out_are_none
        test_sources::test_mirrors_of_a_display_matrix_are_honoured
        test_sources::test_pixels_become_square
        test_live::test_a_recording_s_times_are_kept
        test_deep_frames::test_a_standard_video_keeps_its_codes
        test_deep_frames::test_hdr_video_becomes_light
    """,
    ("In", "camera"): """
        test_capture_device::test_device_drops_to_the_newest_and_reports_being_unplugged
    """,
    ("In", "network stream"): """
        test_network_stream::test_ten_cuts_of_the_line
        test_network_stream::test_ten_cuts_of_an_rtsp_line
    """,
    ("In", "frames in memory"): """
        test_frame_exchange::test_pictures_are_the_same_by_every_way_in
        test_frame_exchange::test_a_frame_on_the_device_is_read_where_it_lies
        test_deep_frames::test_light_above_white_lights_as_it_is
    """,
    ("In", "scene"): """
        test_frame_exchange::test_a_scene_is_found_by_name_and_path
    """,
    ("In", "camera calibration"): """
        test_scene::test_calibration_written_by_opencv
        test_scene::test_calibration_as_ros_and_scripts_write_it
        test_foreign_files::test_calibrations_of_other_programs
        test_foreign_files::test_a_fisheye_projects_as_it_says
        test_photographs::test_a_scene_takes_its_camera_from_exif
    """,
    ("In", "ChArUco boards"): """
        test_foreign_files::test_boards_of_the_old_layout_are_found
    """,
    ("In", "camera response"): """
        test_calibrate::test_response_is_recovered
    """,
    ("In", "mesh with its materials"): """
        test_geometry::test_every_format
        test_formats::test_a_gltf_is_a_mesh
        test_polygon_files::test_area_and_winding_are_kept
        test_polygon_files::test_colours_of_vertices_and_faces_of_a_ply
        test_gltf::test_every_factor_and_texture_arrives
        test_object_materials::test_material_libraries
        test_object_materials::test_meshes_in_memory
    """,
    ("In", "animations of nodes"): """
        test_node_animation::test_parts_stand_where_the_posed_file_has_them
    """,
    ("In", "photographs of a ball"): """
        test_capture::test_a_bracket_becomes_light_and_a_picture
    """,
    ("In", "poses of frames"): """
        test_pose_file::test_poses_of_a_clip
        test_pose_file::test_a_session_takes_poses_by_name
        test_camera_paths::test_colmap_binary_says_what_its_text_does
        test_camera_paths::test_track_by_hand
        test_camera_paths::test_usd_of_another_program
    """,
    ("In", "captured light"): """
        test_captured::test_a_light_survives_its_file
    """,
    ("In", "environment to convert"): """
        test_environment_sink::test_environment_from_separate_channels_and_half
    """,
    ("Out", "lit frames"): """
        test_sinks::test_folder_holds_exactly_what_was_written
        test_sinks::test_video_holds_every_frame_at_its_rate
    """,
    ("Out", "deep lit frames"): """
        test_deep_frames::test_video_of_10_bits_comes_back
        test_deep_frames::test_folders_of_16_bits_and_openexr_come_back
    """,
    ("Out", "lit recordings"): """
        test_farm_depth::test_segments_of_a_deep_recording_are_joined_as_deep_as_it_came
    """,
    ("Out", "a lit frame in memory"): """
        test_frame_exchange::test_pictures_are_the_same_by_every_way_in
        test_frame_exchange::test_a_notebook_shows_the_picture
        test_frame_exchange::test_a_lit_result_is_the_device_s_own_array
        test_deep_frames::test_8_bits_through_a_deep_pipeline_are_the_same_to_the_bit
    """,
    ("Out", "lit frames as a camera"): """
        test_virtual_camera::test_frames_go_to_the_camera
    """,
    ("Out", "layers of a frame"): """
        test_separate::test_layers_together_are_the_picture
    """,
    ("Out", "layers of every frame"): """
        test_layer_file::test_openimageio_reads_every_part
        test_layer_file::test_mattes_are_named
    """,
    ("Out", "depth, normals, ids, plate"): """
        test_layer_file::test_pictures_hold_what_png_can
    """,
    ("Out", "a shot"): """
        test_export::test_usd_shows_corners_where_the_camera_does
        test_export::test_all_materials_of_a_file_are_told_in_usd
        test_export::test_gltf_puts_meshes_where_the_scene_does
        test_export::test_all_materials_of_a_file_are_told_in_gltf
        test_camera_paths::test_what_is_exported_is_read_back
        test_exr_file::test_undistorts_as_opencv_does
    """,
    ("Out", "environment of every frame"): """
        test_environment_sink::test_environment_sink_numbers_its_files
    """,
    ("Out", "environment"): """
        test_environment_file::test_a_latlong_says_its_axes_and_comes_back
        test_environment_file::test_a_cube_is_six_faces_in_one_column
        test_environment_file::test_hdr_holds_the_turned_picture
        test_environment_file::test_json_holds_harmonics
        test_color_spaces::test_acescg_is_aces_own
    """,
    ("Out", "captured light"): """
        test_capture::test_a_bracket_becomes_light_and_a_picture
    """,
    ("Out", "live light"): """
        test_shared_light::test_light_in_all_its_forms
        test_shared_light::test_changes_are_pushed
        test_shared_light::test_three_js_shows_a_ball_as_the_light_says
    """,
    ("Out", "camera response"): """
        test_calibrate::test_response_is_recovered
    """,
    ("Out", "camera calibration"): """
        test_calibrate::test_camera_is_found_and_read_back
        test_foreign_files::test_a_fisheye_is_calibrated
    """,
    ("Out", "card, marker, board"): """
        test_calibrate::test_card_prints_at_exact_size
    """,
    ("Out", "poses and timings"): """
        test_live::test_folder_report_and_environment
    """,
    ("Out", "scene"): """
        test_scene_writer::test_what_is_written_loads_as_it_was
    """,
    ("Out", "costs and errors of methods"): """
        test_tradeoff::test_command_writes_all_three
    """,
}
"""Tests of each row of the page, FILE::NAME."""


def rows(section: str) -> list[list[str]]:
    """Cells of a section's table, without its head."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {section}\n")[1].split("\n## ")[0]
    lines = [line for line in re.sub(r"\[(.*?)\]\(.*?\)", r"\1", text).splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_row_has_its_tests() -> None:
    assert {(section, row[0]) for section in ("In", "Out") for row in rows(section)} == set(TESTS)


@pytest.mark.parametrize("test", sorted({test for tests in TESTS.values() for test in tests.split()}))
def test_the_test_of_a_row_exists(test: str) -> None:
    file, name = test.split("::")
    tree = ast.parse((ROOT / "tests" / f"{file}.py").read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


@pytest.mark.parametrize(
    ("section", "what", "suffixes"),
    [
        ("In", "frames", IMAGE_SUFFIXES),
        ("In", "mesh with its materials", MESH_SUFFIXES),
        ("Out", "lit frames", VIDEO_SUFFIXES),
        ("Out", "environment", ENVIRONMENT_SUFFIXES),
        ("Out", "a shot", (*USD_SUFFIXES, GLTF_SUFFIX, TRACK_SUFFIX)),
    ],
)
def test_every_ending_has_its_row(section: str, what: str, suffixes: tuple[str, ...]) -> None:
    told = {ending for row in rows(section) if row[0] == what for ending in re.findall(r"`(\.\w+)`", row[1])}
    assert told == set(suffixes)


def test_every_mesh_has_a_reader_that_says_what_it_follows() -> None:
    assert set(re.findall(r"`(\.\w+)`", " ".join(READERS))) >= {*MESH_SUFFIXES, ".exr", ".hdr"}
    obj = next(row for row in formats().splitlines() if row.startswith("| `.obj`"))
    assert "surf" in obj
    assert "the material …, which no library has" in obj  # of the code itself


def smooth() -> np.ndarray:
    ramp = np.linspace(20, 220, 64)
    return np.stack([np.tile(ramp, (48, 1)), np.full((48, 64), 90.0), np.tile(ramp[::-1], (48, 1))], 2).astype(np.uint8)


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_pictures_of_every_ending_are_frames(tmp_path: pathlib.Path, suffix: str) -> None:
    if suffix == LINEAR_SUFFIX:
        light = decode_table("srgb")[smooth(), [0, 1, 2]]
        kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(kind, {"RGB": light}).write(str(tmp_path / f"0{suffix}"))
    else:
        (tmp_path / f"0{suffix}").write_bytes(cv2.imencode(suffix, smooth()[..., ::-1])[1].tobytes())
    with open_source(tmp_path) as source:
        frames = [frame.image for frame in source]
    assert len(frames) == 1
    allowed = LOSSY if suffix in (".jpg", ".jpeg", ".webp") else 0
    assert np.abs(frames[0].astype(int) - smooth()).max() <= allowed


@pytest.mark.parametrize(
    ("suffix", "codec"),
    [(".mp4", "libx264"), (".mkv", "libx264"), (".mov", "libx264"), (".webm", "libvpx-vp9"), (".avi", "mjpeg")],
)
def test_videos_of_every_ending_are_frames(tmp_path: pathlib.Path, suffix: str, codec: str) -> None:
    pictures = [smooth(), smooth()[:, ::-1].copy(), smooth()]
    path = write_video(tmp_path / f"clip{suffix}", pictures, codec=codec)
    with open_source(path) as source:
        frames = [frame.image for frame in source]
    assert len(frames) == len(pictures)
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(frame.astype(int) - picture).mean() <= LOSSY


def test_a_gltf_is_a_mesh(tmp_path: pathlib.Path) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(box))
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    mesh = load_mesh(tmp_path / "model.gltf")
    np.testing.assert_allclose(sorted(np.ptp(mesh.vertices, axis=0)), (1.0, 2.0, 3.0), atol=1e-6)
    assert len(mesh.faces) == 12
