"""What Blender shows of an exported shot: ``python blender_shot.py WORK``, by Python with Blender's ``bpy``.

WORK holds ``shot.usda``; ``corners.npz`` with points of the world and the picture's size; ``frame.exr``, a file of
layers. Writes ``seen.npz``: pixels (pixel centres at integers) at which the first frame's camera renders small spheres
that stand at the points, and size and channels of the file of layers.
"""

import pathlib
import sys

import bpy
import numpy as np
from mathutils import Vector

BACKGROUND = 0.1
"""Above what a world gives that says nothing; the spheres' radiance is 1."""
NEAR = 9
"""Pixels around a point in which its sphere's light is looked for."""


def main(work: pathlib.Path) -> None:
    with np.load(work / "corners.npz") as asked:
        points, (width, height), near = asked["points"], asked["size"], asked["expected"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")
    bpy.ops.wm.usd_import(filepath=str(work / "shot.usda"))
    for item in list(bpy.data.objects):
        if item.type != "CAMERA":
            bpy.data.objects.remove(item)
    scene = bpy.context.scene
    scene.camera = next(item for item in bpy.data.objects if item.type == "CAMERA")
    scene.frame_set(0)
    world = bpy.data.worlds.new("black")
    world.color = (0.0, 0.0, 0.0)
    scene.world = world
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 64, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(work / "render.exr")
    shine = bpy.data.materials.new("shine")
    shine.use_nodes = True
    nodes = shine.node_tree.nodes
    nodes.clear()
    emission, out = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    shine.node_tree.links.new(emission.outputs["Emission"], out.inputs["Surface"])
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, radius=0.003)
    ball = bpy.context.object
    ball.data.materials.append(shine)
    pixels = []
    for point, (column, row) in zip(points, near, strict=True):
        ball.location = Vector(point)
        bpy.ops.render.render(write_still=True)
        picture = bpy.data.images.load(str(work / "render.exr"), check_existing=False)
        light = np.array(picture.pixels[:], np.float32).reshape(height, width, -1)[::-1, :, 0] - BACKGROUND
        rows, columns = np.mgrid[:height, :width]
        light = np.where((light > 0.0) & (abs(rows - row) <= NEAR) & (abs(columns - column) <= NEAR), light, 0.0)
        total = max(float(light.sum()), 1e-9)
        pixels.append(((light * columns).sum() / total, (light * rows).sum() / total))
    layers = bpy.data.images.load(str(work / "frame.exr"))
    np.savez(work / "seen.npz", pixels=pixels, size=layers.size[:], channels=layers.channels, kind=layers.type)


main(pathlib.Path(sys.argv[1]))
