"""Labels of every picture of a data set, in the folders and files of the BOP benchmark, with an additional COCO file.

A variation is a BOP scene with the folders ``rgb``, ``depth``, ``mask`` (whole silhouettes) and ``mask_visib`` (visible
parts), and the files ``scene_gt.json``, ``scene_gt_info.json`` and ``scene_camera.json``. In addition, there are the
folder ``normals``, ``scene_light.json`` (the light of each frame), ``scene_gt_coco.json``, and ``scene.toml``, a scene
file that ``python -m warp_ar.live`` can show. Masks, depth and normals are sampled at the pixel's centre.
"""

from __future__ import annotations

import collections
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive
from warp_ar.engine.pipeline import Pipeline
from warp_ar.farm.dataset import Dataset, ObjectSpec
from warp_ar.farm.jobs import JobFile
from warp_ar.farm.lighting import Lit
from warp_ar.files import store
from warp_ar.kernels.picture.object_masks import trace_object_masks
from warp_ar.output.environment_axes import project_radiance
from warp_ar.output.shot import mesh_of
from warp_ar.output.sink import ThreadedSink
from warp_ar.output.sinks import PNG_OPTIONS
from warp_ar.scene import Scene
from warp_ar.signature import encode_png

DEPTH_SCALE = 0.1
"""Millimetres per step of a depth map. The value 0 means that there is no modelled surface, or none within 6.5 m."""
LAYERS = ("image", "ids", "depth", "normals")
"""Outputs of the pipeline from which labels are made."""
_THREADS = 2

Mask = npt.NDArray[np.bool_]


class _Pictures(dict[str, npt.NDArray[Any]]):
    """Pictures of a frame by their paths in the variation's folder, without suffix, as one of ``ThreadedSink``."""

    shape = ()


class LabelWriter(ThreadedSink):
    """Writer of the pictures and labels of one variation."""

    def __init__(self, folder: Path, scene: Scene, kinds: Sequence[int], catalogue: Sequence[ObjectSpec]) -> None:
        """Make the folders.

        Args:
            folder: Existing folder of the variation.
            scene: Scene of the variation; its camera has the frames' size.
            kinds: Index in the catalogue of each object.
            catalogue: Kinds from which objects are drawn.
        """
        super().__init__(_THREADS)
        self.description = str(folder)
        self._folder, self._scene, self._kinds, self._catalogue = folder, scene, kinds, catalogue
        self._tables: dict[str, dict[str, Any]] = {name: {} for name in ("gt", "gt_info", "camera", "light")}
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._masks: Any = None
        for name in ("rgb", "depth", "normals", "mask", "mask_visib"):
            (folder / name).mkdir()

    def label(self, lit: Lit, key: int | None) -> None:
        """Label a frame, and write its pictures on a thread.

        Args:
            lit: The lit frame; its pipeline must not have lit another one since.
            key: Index of the environment map in the clip's survey; None if all frames have one environment.

        Raises:
            SinkError: A file cannot be written.
        """
        assert lit.result is not None
        assert lit.pose is not None
        number, layers = lit.frame.index, lit.result.layers
        whole = self._trace(lit.pipeline)
        visible = layers["ids"]
        depth = layers["depth"] * (1e3 / DEPTH_SCALE)
        depth = np.where(np.isfinite(depth) & (depth < 65535.5), depth, 0.0)
        normals = layers["normals"] @ lit.pose.rotation.T.astype(np.float32)
        codes = (
            np.rint((0.5 + 0.5 * np.clip(normals, -1.0, 1.0)) * 65535.0) * (layers["normals"] != 0).any(2)[..., None]
        )
        files = {
            f"rgb/{number:06d}": lit.image,
            f"depth/{number:06d}": np.rint(depth).astype(np.uint16),
            f"normals/{number:06d}": codes.astype(np.uint16),
        }
        self._note_frame(lit)
        self._note_light(lit, key)
        poses, infos = [], []
        for index, kind in enumerate(self._kinds):
            silhouette = (whole >> np.uint64(index)) & np.uint64(1) != 0
            seen = visible == index
            files[f"mask/{number:06d}_{index:06d}"] = silhouette.astype(np.uint8) * 255
            files[f"mask_visib/{number:06d}_{index:06d}"] = seen.astype(np.uint8) * 255
            poses.append(self._pose(lit, index, kind))
            infos.append(_info(silhouette | seen, seen, depth > 0.0))
            if infos[-1]["px_count_visib"]:
                self._annotate(number, kind, seen, infos[-1])
        self._tables["gt"][str(number)] = poses
        self._tables["gt_info"][str(number)] = infos
        self.write(_Pictures(files))

    def _check(self, image: Any) -> None:
        """Take any pictures."""

    def _store(self, index: int, image: Any) -> None:
        for name, picture in image.items():
            store(self._folder / f"{name}.png", encode_png(picture, PNG_OPTIONS if picture.ndim == 3 else ()))

    def _trace(self, pipeline: Pipeline) -> npt.NDArray[np.uint64]:
        """Return the objects that the ray of each pixel hits, occluded or not, as one bit per object, (h, w)."""
        arrays = pipeline.arrays
        with exclusive(pipeline.device), wp.ScopedDevice(pipeline.device):
            if self._masks is None:
                self._masks = wp.zeros(arrays["rays"].shape, dtype=wp.uint64)
            trace_object_masks(arrays["params"], arrays["rays"], arrays["ray_scene"], self._masks)
            return np.array(self._masks.numpy())

    def _pose(self, lit: Lit, index: int, kind: int) -> dict[str, Any]:
        """Return the pose of an object in a frame, ``camera_from_model`` in millimetres, in BOP's form.

        Args:
            lit: The frame.
            index: Index of the object in the scene.
            kind: Index of its kind in the catalogue.
        """
        assert lit.pose is not None
        rotation, position = self._scene.objects[index].pose_at(lit.frame.time)
        placed = lit.pose.rotation @ rotation
        return {
            "cam_R_m2c": _numbers(placed.ravel()),
            "cam_t_m2c": _numbers(1e3 * lit.pose.apply(position)),
            "obj_id": kind + 1,
        }

    def _note_frame(self, lit: Lit) -> None:
        assert lit.pose is not None
        camera, number = self._scene.camera, lit.frame.index
        self._tables["camera"][str(number)] = {
            "cam_K": _numbers(camera.matrix().ravel()),
            "cam_dist": _numbers(camera.distortion),
            "cam_R_w2c": _numbers(lit.pose.rotation.ravel()),
            "cam_t_w2c": _numbers(1e3 * lit.pose.translation),
            "depth_scale": DEPTH_SCALE,
        }
        self._images.append(
            {"id": number, "file_name": f"rgb/{number:06d}.png", "width": camera.width, "height": camera.height}
        )

    def _note_light(self, lit: Lit, key: int | None) -> None:
        """Record the environment as nine spherical harmonics of radiance, and the frame's virtual lights."""
        environment, harmonics = lit.pipeline.arrays.get("environment"), None
        if environment is not None:
            with exclusive(lit.pipeline.device):
                harmonics = [_numbers(row) for row in project_radiance(environment.numpy())]
        lights = []
        for light in self._scene.lights:
            position, direction = light.pose_at(lit.frame.time)
            lights.append(
                {
                    "kind": light.kind,
                    "intensity": light.intensity,
                    "color": list(light.color),
                    "position": _numbers(position),
                    "direction": _numbers(direction),
                    "radius": light.radius,
                    "inner_angle": light.inner_angle,
                    "outer_angle": light.outer_angle,
                }
            )
        self._tables["light"][str(lit.frame.index)] = {
            "environment_key": key,
            "environment_harmonics": harmonics,
            "exposure_scale": self._scene.exposure.scale,
            "lights": lights,
        }

    def _annotate(self, number: int, kind: int, seen: Mask, info: dict[str, Any]) -> None:
        self._annotations.append(
            {
                "id": len(self._annotations) + 1,
                "image_id": number,
                "category_id": kind + 1,
                "iscrowd": 0,
                "area": info["px_count_visib"],
                "bbox": info["bbox_visib"],
                "segmentation": {"size": list(seen.shape), "counts": run_lengths(seen)},
                "visib_fract": info["visib_fract"],
            }
        )

    def finish(self) -> int:
        """Write the tables; return the number of frames.

        Raises:
            SinkError: A file cannot be written.
        """
        coco = {
            "images": self._images,
            "annotations": self._annotations,
            "categories": categories(self._catalogue),
        }
        names = {**{f"scene_{name}": table for name, table in self._tables.items()}, "scene_gt_coco": coco}
        for name, table in names.items():
            store(self._folder / f"{name}.json", json.dumps(table).encode())
        return len(self._images)


def categories(catalogue: Sequence[ObjectSpec]) -> list[dict[str, Any]]:
    """Return the catalogue's kinds of objects as categories in COCO's form."""
    return [{"id": index + 1, "name": spec.name, "supercategory": "object"} for index, spec in enumerate(catalogue)]


def run_lengths(mask: Mask) -> list[int]:
    """Return the lengths of runs of equal pixels in a mask, column by column, beginning with unset pixels (COCO)."""
    flat = mask.T.ravel().view(np.uint8)
    ends = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff(np.concatenate([[0], ends, [len(flat)]])).tolist()
    return [0, *counts] if flat[0] else list(counts)


def _info(whole: Mask, seen: Mask, measured: Mask) -> dict[str, Any]:
    """Return BOP's numbers of pixels and bounding boxes of one object in one picture.

    Args:
        whole: Silhouette of the object inside the picture.
        seen: Visible part of the silhouette.
        measured: Pixels with a depth.
    """
    pixels, visible = int(whole.sum()), int(seen.sum())
    return {
        "bbox_obj": _box(whole),
        "bbox_visib": _box(seen),
        "px_count_all": pixels,
        "px_count_valid": int((whole & measured).sum()),
        "px_count_visib": visible,
        "visib_fract": visible / pixels if pixels else 0.0,
    }


def _box(mask: Mask) -> list[int]:
    """Return x, y, width and height of a mask's set pixels; -1 for an empty mask."""
    return list(map(int, cv2.boundingRect(mask.view(np.uint8)))) if mask.any() else [-1] * 4


def _numbers(values: Any) -> list[float]:
    return [round(float(v), 9) for v in values]


_LISTED = 50
"""Largest number of clips that a datasheet names."""


def write_dataset_files(jobs: JobFile, places: Sequence[Path], folder: Path, run: Path, version: str) -> dict[str, Any]:
    """Write ``models``, ``annotations.json`` and ``datasheet.md``.

    Args:
        jobs: The job file.
        places: Folders of the finished variations in order, relative to the run's folder.
        folder: Existing, empty folder to write to.
        run: Folder of the run.
        version: Version of the program.

    Returns:
        Numbers of pictures and labels of the data set.
    """
    dataset = jobs.dataset
    assert dataset is not None
    _write_models(dataset.catalogue, folder / "models")
    counts = _write_coco(dataset, places, folder / "annotations.json", run)
    sheet = _datasheet(jobs, dataset, places, counts, version)
    (folder / "datasheet.md").write_text(sheet, encoding="utf-8")
    return {"pictures": counts["pictures"], "labels": counts["labels"]}


def _write_models(catalogue: Sequence[ObjectSpec], folder: Path) -> None:
    """Write one PLY file for each kind of object, and the sizes of all in BOP's form."""
    import trimesh  # imported here, because no other job needs it

    folder.mkdir()
    table = {}
    names = ("min_x", "min_y", "min_z", "size_x", "size_y", "size_z")
    for number, spec in enumerate(catalogue, 1):
        made = mesh_of(spec.item)
        vertices = 1e3 * spec.item.scale * made.vertices
        mesh = trimesh.Trimesh(vertices, made.faces, vertex_normals=made.normals, process=False)
        (folder / f"obj_{number:06d}.ply").write_bytes(mesh.export(file_type="ply", vertex_normal=True))
        low, high = mesh.bounds
        table[str(number)] = {
            "diameter": _diameter(np.asarray(mesh.vertices)),
            **dict(zip(names, np.round([*low, *(high - low)], 6).tolist(), strict=True)),
            "name": spec.name,
        }
    (folder / "models_info.json").write_text(json.dumps(table, indent=1), encoding="utf-8")


def _diameter(vertices: Any) -> float:
    """Return the largest distance between two vertices in millimetres.

    Only vertices that are extreme in one of 2000 directions are compared.
    """
    golden = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(2000)
    z = 1.0 - (np.arange(2000) + 0.5) / 1000.0
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(golden), np.sqrt(1 - z * z) * np.sin(golden), z])
    kept = vertices[np.unique(np.concatenate([np.argmax(vertices @ part, 0) for part in np.split(directions, 8, 1)]))]
    return round(float(max(np.linalg.norm(kept - point, axis=1).max() for point in kept)), 6)


def _write_coco(dataset: Dataset, places: Sequence[Path], path: Path, run: Path) -> collections.Counter[str]:
    """Merge the COCO files of all variations into one, with consecutive numbers, holding one file in memory at a time.

    Args:
        dataset: Kinds of objects and lights.
        places: Folders of the variations, relative to the run's folder.
        path: File to write.
        run: Folder of the run.

    Returns:
        Number of ``pictures``, of ``labels``, and of labels of each ``category N``.
    """
    counts: collections.Counter[str] = collections.Counter()
    annotations = path.with_suffix(".part")
    with open(path, "w", encoding="utf-8") as images, open(annotations, "w+", encoding="utf-8") as labels:
        images.write('{"categories": ' + json.dumps(categories(dataset.catalogue)) + ',\n"images": [')
        for place in places:
            table = json.loads((run / place / "scene_gt_coco.json").read_text(encoding="utf-8"))
            first = counts["pictures"]
            ids = {image["id"]: first + n for n, image in enumerate(table["images"], 1)}
            for image in table["images"]:
                name = (place / image["file_name"]).relative_to("dataset").as_posix()
                images.write("\n" if counts["pictures"] == 0 else ",\n")
                images.write(json.dumps({**image, "id": ids[image["id"]], "file_name": name}))
                counts["pictures"] += 1
            for label in table["annotations"]:
                labels.write("\n" if counts["labels"] == 0 else ",\n")
                counts["labels"] += 1
                labels.write(json.dumps({**label, "id": counts["labels"], "image_id": ids[label["image_id"]]}))
                counts[f"category {label['category_id']}"] += 1
        images.write('],\n"annotations": [')
        labels.seek(0)
        shutil.copyfileobj(labels, images)
        images.write("]}\n")
    annotations.unlink()
    return counts


def _datasheet(
    jobs: JobFile, dataset: Dataset, places: Sequence[Path], counts: collections.Counter[str], version: str
) -> str:
    """Return the text of the datasheet: contents, origin and limits of the data set."""
    categories = "\n".join(
        f"| {number} | {spec.name} | {spec.item.shape} | {counts[f'category {number}']} |"
        for number, spec in enumerate(dataset.catalogue, 1)
    )
    clips = [f"- `{clip.name}`: scene `{Path(clip.scene).name}`" for clip in jobs.clips[:_LISTED]]
    if len(jobs.clips) > _LISTED:
        clips.append(f"- and {len(jobs.clips) - _LISTED} more")
    recordings = "\n".join(clips)
    return f"""# Datasheet

{counts["pictures"]} pictures with {counts["labels"]} visible objects,
in {len(places)} of {len(jobs.clips) * dataset.variations} planned variations of {len(jobs.clips)} clips.
Made by {version}, quality `{jobs.settings.quality}`, seed {dataset.seed}: the same job file gives the same bytes on any
number of workers.

## Composition

Every picture is a frame of a recording in which virtual objects stand on the desk, lit by the light of that recording
and by virtual lights. Labels come from the geometry that was rendered; nobody drew them.

| category | name | shape | visible in pictures |
| --- | --- | --- | --: |
{categories}

{dataset.objects[0]} to {dataset.objects[1]} objects and {dataset.lights[0]} to {dataset.lights[1]} virtual lights in a
picture; exposure {dataset.exposure[0]:g} to {dataset.exposure[1]:g}.
Objects stand {dataset.margin:g} m apart at least and hide the marker from no camera of the clip.

## Files

- `train/NNNNNN/`: a variation as a BOP scene; `scene.toml` draws it again
- `depth`: 16-bit PNG, {DEPTH_SCALE:g} mm a step along the camera's axis; 0 where nothing is modelled
- `normals`: 16-bit PNG, (n + 1) / 2 in the camera's axes (x right, y down, z forward); 0 where nothing is modelled
- `mask`: the silhouette within the picture, whatever is before it; `mask_visib`: what is seen of it
- `scene_light.json`: virtual lights in the world's metres, and the environment as nine spherical harmonics of its
  radiance; `environment_key` numbers the map in `clips/NAME/lights.bin` of the run
- `annotations.json`: COCO, over all variations; `models/`: PLY in millimetres with `models_info.json`

## Clips

{recordings}

## What it is not

- Pixels are labelled by what is at their centre; edges in the pictures are smooth.
- A picture with lens distortion keeps it: `cam_K` alone does not project into it, `cam_dist` says the rest.
- Silhouettes end at the picture's border, so `visib_fract` counts no part that is beside it.
- What is real but not modelled hides no virtual object, has no depth and no label.
- An object that lies any way up touches the desk with its lowest point; whether it would tip over is not asked.
- People and rooms of the recordings are in the pictures: whose consent they need is not asked here.
"""
