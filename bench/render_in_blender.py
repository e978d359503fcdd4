"""Renders a shot for ``bench.beside_cycles``: ``python render_in_blender.py WORK``, by Python with Blender's ``bpy``.

WORK holds ``shot.usda`` and ``asked.npz``: reflectances of the proxies, the picture's size, samples, and the rows and
columns that are rendered. Proxies become shadow catchers. Writes ``render.exr``: linear RGBA of the whole size,
premultiplied, which lies over the plate, and ``seconds.npy``.
"""

import pathlib
import sys
import time

import bpy
import numpy as np


def matt(name: str, color: np.ndarray) -> bpy.types.Material:
    """A diffuse material."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    diffuse, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    diffuse.inputs["Color"].default_value = (*(float(c) for c in color), 1.0)
    material.node_tree.links.new(diffuse.outputs["BSDF"], out.inputs["Surface"])
    return material


def main(work: pathlib.Path) -> None:
    with np.load(work / "asked.npz") as asked:
        reflectances, (width, height), samples = asked["reflectances"], asked["size"], int(asked["samples"])
        (top, bottom), (left, right) = asked["rows"], asked["columns"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")  # else the importer leaves dome lights out
    bpy.ops.wm.usd_import(filepath=str(work / "shot.usda"))
    scene = bpy.context.scene
    scene.camera = next(item for item in bpy.data.objects if item.type == "CAMERA")
    catchers = [item for item in bpy.data.objects if item.type == "MESH" and item.name.startswith("proxy_")]
    assert len(catchers) == len(reflectances), [item.name for item in catchers]
    for catcher, color in zip(sorted(catchers, key=lambda item: item.name), reflectances, strict=True):
        catcher.is_shadow_catcher = True
        catcher.data.materials.clear()
        catcher.data.materials.append(matt(catcher.name, color))
    scene.frame_set(0)
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", samples, False
    scene.cycles.use_adaptive_sampling, scene.cycles.sample_clamp_indirect = False, 0.0
    scene.render.film_transparent = True
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    scene.render.resolution_percentage = 100
    scene.render.use_border, scene.render.use_crop_to_border = True, False
    scene.render.border_min_x, scene.render.border_max_x = left / width, right / width
    scene.render.border_min_y, scene.render.border_max_y = 1.0 - bottom / height, 1.0 - top / height
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGBA", "32"
    scene.render.filepath = str(work / "render.exr")
    start = time.perf_counter()
    bpy.ops.render.render(write_still=True)
    np.save(work / "seconds.npy", time.perf_counter() - start)


main(pathlib.Path(sys.argv[1]))
