"""What a data set has beside its pictures: models, one COCO file over all variations, a datasheet."""

from __future__ import annotations

import collections
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warp_ar.errors import SinkError, reason
from warp_ar.farm.catalogue import Dataset, ObjectSpec
from warp_ar.farm.jobs import JobFile
from warp_ar.farm.labels import DEPTH_SCALE, categories
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.shapes import torus_mesh

_LISTED = 50
"""Clips that a datasheet names."""


def write_dataset_files(jobs: JobFile, places: Sequence[Path], folder: Path, run: Path, version: str) -> dict[str, Any]:
    """Write ``models``, ``annotations.json`` and ``datasheet.md``.

    Args:
        jobs: The job file.
        places: Folders of the finished variations, relative to the run's, in their order.
        folder: Where to write; it is there, and empty.
        run: The run's folder.
        version: Of the program.

    Returns:
        Pictures and labels of the data set.

    Raises:
        SinkError: A file cannot be written.
    """
    dataset = jobs.dataset
    assert dataset is not None
    try:
        _write_models(dataset.catalogue, folder / "models")
        counts = _write_coco(dataset, places, folder / "annotations.json", run)
        sheet = _datasheet(jobs, dataset, places, counts, version)
        (folder / "datasheet.md").write_text(sheet, encoding="utf-8")
    except OSError as error:
        raise SinkError(f"{folder} cannot be written: {reason(error)}") from error
    return {"pictures": counts["pictures"], "labels": counts["labels"]}


def _model(spec: ObjectSpec) -> trimesh.Trimesh:
    """Triangles of an object in millimetres, about the origin that its pose moves."""
    item = spec.item
    if item.shape == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=item.radius)
    elif item.shape == "box":
        mesh = trimesh.creation.box(item.size)
    else:
        if item.shape == "mesh":
            assert item.file is not None
            made = load_kept_mesh(item.file)
        else:
            made = torus_mesh(item.major_radius, item.minor_radius)
        mesh = trimesh.Trimesh(made.vertices, made.faces, vertex_normals=made.normals, process=False)
    mesh.apply_scale(1e3 * item.scale)
    return mesh


def _write_models(catalogue: Sequence[ObjectSpec], folder: Path) -> None:
    """One PLY for each object, and their sizes as BOP has them."""
    folder.mkdir()
    table = {}
    for number, spec in enumerate(catalogue, 1):
        mesh = _model(spec)
        (folder / f"obj_{number:06d}.ply").write_bytes(mesh.export(file_type="ply", vertex_normal=True))
        low, high = np.asarray(mesh.bounds)
        x, y, z = (round(float(v), 6) for v in low)
        a, b, c = (round(float(v), 6) for v in high - low)
        table[str(number)] = {
            "diameter": _diameter(np.asarray(mesh.vertices)),
            **dict(zip(("min_x", "min_y", "min_z"), (x, y, z), strict=True)),
            **dict(zip(("size_x", "size_y", "size_z"), (a, b, c), strict=True)),
            "name": spec.name,
        }
    (folder / "models_info.json").write_text(json.dumps(table, indent=1), encoding="utf-8")


def _diameter(vertices: Any) -> float:
    """Largest distance between two points, in millimetres; only extreme points along many directions are compared."""
    golden = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(2000)
    z = 1.0 - (np.arange(2000) + 0.5) / 1000.0
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(golden), np.sqrt(1 - z * z) * np.sin(golden), z])
    kept = vertices[np.unique(np.concatenate([np.argmax(vertices @ part, 0) for part in np.split(directions, 8, 1)]))]
    return round(float(max(np.linalg.norm(kept - point, axis=1).max() for point in kept)), 6)


def _variations(places: Sequence[Path], run: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for place in places:
        yield place, json.loads((run / place / "scene_gt_coco.json").read_text(encoding="utf-8"))


def _write_coco(dataset: Dataset, places: Sequence[Path], path: Path, run: Path) -> collections.Counter[str]:
    """Join the COCO files of all variations, one at a time: numbers go on from one to the next."""
    counts: collections.Counter[str] = collections.Counter()
    annotations = path.with_suffix(".part")
    with open(path, "w", encoding="utf-8") as images, open(annotations, "w+", encoding="utf-8") as labels:
        images.write('{"categories": ' + json.dumps(categories(dataset.catalogue)) + ',\n"images": [')
        for place, table in _variations(places, run):
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
        while part := labels.read(1 << 20):
            images.write(part)
        images.write("]}\n")
    annotations.unlink()
    return counts


_SHEET = """# Datasheet

{pictures} pictures with {labels} visible objects, in {made} of {planned} planned variations of {clips} clips. Made by
{version}, quality `{quality}`, seed {seed}: the same job file gives the same bytes on any number of workers.

## Composition

Every picture is a frame of a recording in which virtual objects stand on the desk, lit by the light of that recording
and by virtual lights. Labels come from the geometry that was rendered; nobody drew them.

| category | name | shape | visible in pictures |
| --- | --- | --- | --: |
{categories}

{objects[0]} to {objects[1]} objects and {lights[0]} to {lights[1]} virtual lights in a picture; exposure {low:g} to
{high:g}. Objects stand {margin:g} m apart at least and hide the marker from no camera of the clip.

## Files

- `train/NNNNNN/`: a variation as a BOP scene; `scene.toml` draws it again
- `depth`: 16-bit PNG, {step:g} mm a step along the camera's axis; 0 where nothing is modelled
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


def _datasheet(
    jobs: JobFile, dataset: Dataset, places: Sequence[Path], counts: collections.Counter[str], version: str
) -> str:
    """What the data set is, how it was made, and what it is not."""
    rows = (
        f"| {number} | {spec.name} | {spec.item.shape} | {counts[f'category {number}']} |"
        for number, spec in enumerate(dataset.catalogue, 1)
    )
    clips = [f"- `{clip.name}`: scene `{Path(clip.scene).name}`" for clip in jobs.clips[:_LISTED]]
    if len(jobs.clips) > _LISTED:
        clips.append(f"- and {len(jobs.clips) - _LISTED} more")
    return _SHEET.format(
        pictures=counts["pictures"],
        labels=counts["labels"],
        made=len(places),
        planned=len(jobs.clips) * dataset.variations,
        clips=len(jobs.clips),
        version=version,
        quality=jobs.settings.quality,
        seed=dataset.seed,
        categories="\n".join(rows),
        objects=dataset.objects,
        lights=dataset.lights,
        low=dataset.exposure.low[0],
        high=dataset.exposure.high[0],
        margin=dataset.margin,
        step=DEPTH_SCALE,
        recordings="\n".join(clips),
    )
