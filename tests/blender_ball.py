"""Renders a grey ball in the light of a USD: ``python blender_ball.py STAGE OUT``, by Python with Blender's ``bpy``.

Writes OUT.npz: the picture of an orthographic camera that looks along -x of the world, linear, and the ball's albedo.
"""

import sys

import bpy
import numpy as np

SIZE, ALBEDO = 64, 0.5


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # Without a world the importer leaves dome lights out.
    bpy.context.scene.world = bpy.data.worlds.new("world")
    bpy.ops.wm.usd_import(filepath=sys.argv[1])
    for item in list(bpy.data.objects):
        if item.type == "MESH":
            bpy.data.objects.remove(item)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_uv_sphere_add(segments=128, ring_count=64, radius=1.0, location=(0, 0, 0))
    ball = bpy.context.object
    bpy.ops.object.shade_smooth()
    grey = bpy.data.materials.new("grey")
    grey.use_nodes = True
    nodes = grey.node_tree.nodes
    nodes.clear()
    diffuse, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    diffuse.inputs["Color"].default_value = (ALBEDO, ALBEDO, ALBEDO, 1.0)
    grey.node_tree.links.new(diffuse.outputs["BSDF"], out.inputs["Surface"])
    ball.data.materials.append(grey)
    lens = bpy.data.cameras.new("flat")
    lens.type, lens.ortho_scale = "ORTHO", 2.2
    camera = bpy.data.objects.new("flat", lens)
    camera.location = (5.0, 0.0, 0.0)
    camera.rotation_euler = (np.pi / 2, 0.0, np.pi / 2)  # looks along -x, z up, y to the right
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 512, False
    scene.cycles.use_adaptive_sampling = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = sys.argv[2] + ".exr"
    bpy.ops.render.render(write_still=True)
    picture = bpy.data.images.load(sys.argv[2] + ".exr")
    pixels = np.array(picture.pixels[:], np.float32).reshape(SIZE, SIZE, -1)[::-1, :, :3]
    np.savez(sys.argv[2] + ".npz", pixels=pixels, albedo=ALBEDO)


main()
