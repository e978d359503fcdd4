"""Labels of a data set: what BOP and COCO say is what the picture shows."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import trimesh
import warp as wp

from tests.farm_rig import SIZE, make_jobs, write_recording
from tests.kernel_rig import camera_fields, look_at, records
from warp_ar.farm.jobs import Context, Job
from warp_ar.farm.labels import DEPTH_SCALE
from warp_ar.farm.manifest import Manifest
from warp_ar.farm.work import Work
from warp_ar.kernels.picture.object_masks import trace_object_masks
from warp_ar.kernels.structs import FrameParams
from warp_ar.scene import Object, Scene, load_scene
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.scene.ray_scene import HostScene

pytestmark = pytest.mark.slow

DATASET = {
    "variations": 2,
    "seed": 4,
    "objects": [3, 3],
    "every": 2,
    "region": [-0.2, -0.2, 0.2, 0.1],
    "object": [
        {"name": "ball", "shape": "sphere", "radius": 0.02},
        {"name": "die", "shape": "box", "size": [0.03, 0.04, 0.02], "rest": "any"},
        {"name": "ring", "shape": "torus", "major_radius": 0.02, "minor_radius": 0.006, "scale": 1.2},
    ],
    "light": [{"kind": "point", "at": [0.1, -0.2, 0.4], "intensity": [0.5, 2.0]}],
}
EDGE = 1.5
"""Pixels by which the outline of a mesh may be off one that is drawn in whole pixels."""
ROUNDED_MM = 0.5 * DEPTH_SCALE + 0.02
"""Half a step of the depth map, and float32 at half a metre."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished data set of two variations of three frames."""
    folder = tmp_path_factory.mktemp("labels")
    write_recording(folder / "a.mp4", 5)
    jobs = make_jobs(folder, [{"scene": "desk", "path": "a.mp4"}], dataset=DATASET)
    work, manifest = Work(Context(jobs, folder / "run", "cpu")), Manifest(folder / "run")
    todo = [Job("survey"), Job("variation", 0, 0, 0, 5), Job("variation", 0, 1, 0, 5)]
    for job in todo:
        outcome = work.do(job)
        assert outcome.state == "done", outcome.reason
        manifest.add("done", job.key(jobs))
    assert outcome.values["frames"] == 3
    outcome = work.do(Job("index"))
    assert outcome.state == "done", outcome.reason
    work.close()
    return folder / "run/dataset"


def tables(made, number=0):
    folder = made / f"train/{number:06d}"
    return folder, {path.stem: json.loads(path.read_text()) for path in folder.glob("scene_*.json")}


def test_models_moved_by_their_poses_are_where_the_masks_are(made):
    _, table = tables(made)
    models = {number: trimesh.load(made / f"models/obj_{number:06d}.ply") for number in (1, 2, 3)}
    for frame, poses in table["scene_gt"].items():
        camera = table["scene_camera"][frame]
        matrix = np.array(camera["cam_K"]).reshape(3, 3)
        for index, pose in enumerate(poses):
            rotation, place = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"])
            points = np.asarray(models[pose["obj_id"]].vertices) @ rotation.T + place
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)[0].reshape(-1, 2)
            x, y, width, height = table["scene_gt_info"][frame][index]["bbox_obj"]
            low, high = pixels.min(0), pixels.max(0)
            assert np.abs(low - [x, y]).max() < EDGE
            assert np.abs(high - [x + width - 1, y + height - 1]).max() < EDGE


def test_depth_is_that_of_the_ball_and_normals_point_from_its_centre(made):
    for number in (0, 1):
        folder, table = tables(made, number)
        for frame, poses in table["scene_gt"].items():
            depth, codes = (
                cv2.imread(str(folder / f"{name}/{int(frame):06d}.png"), cv2.IMREAD_UNCHANGED)
                for name in ("depth", "normals")
            )
            depth = depth * DEPTH_SCALE
            matrix = np.array(table["scene_camera"][frame]["cam_K"]).reshape(3, 3)
            for index, pose in enumerate(poses):
                if pose["obj_id"] != 1:
                    continue
                seen = cv2.imread(str(folder / f"mask_visib/{int(frame):06d}_{index:06d}.png"), 0) > 0
                y, x = np.nonzero(seen)
                ray = np.stack(
                    [(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones(len(x))], -1
                )
                center, radius = np.array(pose["cam_t_m2c"]), 20.0
                a, b, c = (ray * ray).sum(1), ray @ center, center @ center - radius**2
                expected = (b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
                inner = b * b - a * c > 0.05 * a * radius**2  # at the rim depth changes without bound
                assert inner.sum() > 50
                assert np.abs(depth[y, x] - expected)[inner].max() < ROUNDED_MM
                normals = codes[y, x, ::-1] / 32767.5 - 1.0
                outward = (ray * depth[y, x, None] - center) / radius
                assert np.abs(normals - outward).max() < 2e-2  # half a step of depth, seen at a grazing angle


def test_visible_parts_lie_within_silhouettes_and_apart(made):
    folder, table = tables(made)
    for frame, infos in table["scene_gt_info"].items():
        covered = np.zeros(SIZE[::-1], int)
        for index, info in enumerate(infos):
            whole = cv2.imread(str(folder / f"mask/{int(frame):06d}_{index:06d}.png"), 0) > 0
            seen = cv2.imread(str(folder / f"mask_visib/{int(frame):06d}_{index:06d}.png"), 0) > 0
            assert not (seen & ~whole).any()
            covered += seen
            assert (info["px_count_all"], info["px_count_visib"]) == (whole.sum(), seen.sum())
            assert info["visib_fract"] == pytest.approx(seen.sum() / whole.sum())
        assert covered.max() == 1


def test_coco_counts_and_runs_are_those_of_the_masks(made):
    coco = json.loads((made / "annotations.json").read_text())
    assert [image["id"] for image in coco["images"]] == list(range(1, 7))
    assert len({label["id"] for label in coco["annotations"]}) == len(coco["annotations"]) > 12
    names = {image["id"]: image["file_name"] for image in coco["images"]}
    assert all((made / name).is_file() for name in names.values())
    assert {entry["name"] for entry in coco["categories"]} == {"ball", "die", "ring"}
    for label in coco["annotations"]:
        height, width = label["segmentation"]["size"]
        counts = label["segmentation"]["counts"]
        mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(width, height).T
        assert mask.sum() == label["area"]
        y, x = np.nonzero(mask)
        assert label["bbox"] == [x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1]


def test_light_is_told_for_every_frame(made):
    _, table = tables(made)
    assert list(table["scene_light"]) == list(table["scene_camera"]) == ["0", "2", "4"]
    light = table["scene_light"]["2"]
    assert np.array(light["environment_harmonics"]).shape == (9, 3)
    assert light["lights"][0]["position"] == [0.1, -0.2, 0.4]


def test_the_datasheet_counts(made):
    text = (made / "datasheet.md").read_text()
    assert text.startswith("# Datasheet\n\n6 pictures with ")
    assert "in 2 of 2 planned variations" in text


def test_silhouettes_are_those_of_each_object_alone(device):
    """Objects one behind the other: the hidden one's bits are those it has in a scene of its own."""
    items = (
        Object("sphere", radius=0.05, at=(0.0, 0.1, 0.06)),
        Object("box", size=(0.06, 0.2, 0.03), at=(0.02, 0.25, 0.05), rotate=(0.0, 20.0, 30.0)),
        Object("torus", major_radius=0.06, minor_radius=0.02, at=(0.03, 0.0, 0.05), rotate=(50.0, 0.0, 0.0)),
    )
    camera, inverse = load_scene("desk").camera, look_at((0.1, -0.5, 0.3)).inverse()
    rows, columns = camera.height, camera.width
    fields = camera_fields(inverse.translation, inverse.rotation, camera.fx, (rows, columns))
    params = records(FrameParams, {**fields, "object_rect": (0, rows, 0, columns)}, device=device)
    rays = wp.array(pixel_rays(camera).astype(np.float32), dtype=wp.vec2, device=device)

    def masks(objects):
        host, out = HostScene(Scene(camera, objects=objects), device), wp.zeros(rays.shape, wp.uint64, device=device)
        trace_object_masks(params, rays, host.ray_scene, out)
        return out.numpy()

    together = masks(items)
    for index, item in enumerate(items):
        alone = masks((item,))
        assert alone.any()
        np.testing.assert_array_equal((together >> np.uint64(index)) & np.uint64(1), alone)
    assert ((together & (together - np.uint64(1))) != 0).any(), "some pixel must see two"
