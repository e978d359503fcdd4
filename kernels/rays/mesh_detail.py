"""Alpha, single-sided triangles and normal maps of meshes.

A triangle may be cut out by its alpha (masked), let a share of rays pass (blended), or be visible from one side alone.
A normal map tilts the shading normal. ``kernels/rays/trace.py`` includes this code if ``TraceConfig.detail`` is set.

References:
    [WM17] Wyman, McGuire, "Hashed Alpha Testing", I3D 2017.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.rays.shapes import FAR, ROUNDING, Contact, intersect_mesh
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits
from warp_ar.kernels.structs import BLENDED, OPAQUE, Hit, RayScene, Shape
from warp_ar.kernels.textures import point_of_triangle, sample_texture, slant

wp.set_module_options({"enable_backward": False})

MOST_LAYERS = wp.constant(64)
"""Largest number of transparent triangles of one mesh that a ray crosses; beyond them it meets none."""


@wp.func
def is_there(
    scene: RayScene, shape: Shape, contact: Contact, origin: wp.vec3, direction: wp.vec3, sided: wp.bool
) -> wp.bool:
    """Return whether the triangle at ``contact`` stops a ray; if ``sided``, single-sided ones let it pass from behind.

    Blended triangles stop a share of rays equal to their alpha, by a threshold hashed from cells of space about a pixel
    wide. So the pattern stays with the surface when the camera moves [WM17].
    """
    corner = shape.first_vertex + 3 * contact.face
    index = shape.material
    if scene.triangle_materials.shape[0] > 0:
        index += scene.triangle_materials[corner / 3]
    material = scene.materials[index]
    if sided and material.single_sided != 0:
        if wp.dot(wp.mesh_eval_face_normal(shape.mesh, contact.face), direction) > 0.0:
            return False
    if material.alpha_mode == OPAQUE:
        return True
    uvs = scene.vertex_uvs
    w = 1.0 - contact.u - contact.v
    uv = contact.u * uvs[corner] + contact.v * uvs[corner + 1] + w * uvs[corner + 2]
    weights = wp.vec2(contact.u, contact.v)
    width = scene.pixel_spread * contact.t
    point = point_of_triangle(scene, corner, weights, uv, width, shape.scale)
    alpha = material.opacity * point.color[3]
    if material.base_texture >= 0:
        alpha *= sample_texture(scene, material.base_texture, point)[3]
    if material.alpha_mode == BLENDED:
        place = origin + contact.t * direction
        finest = 1.0e-6 * wp.length(shape.extent) + 1.0e-30
        cells = wp.pow(2.0, -wp.ceil(wp.log2(wp.max(width / shape.scale, finest))))
        cell = place * cells
        bits = pcg3d_hash(
            wp.uint32(wp.int32(wp.floor(cell[0]))),
            wp.uint32(wp.int32(wp.floor(cell[1]))),
            wp.uint32(wp.int32(wp.floor(cell[2]))),
        )
        return uniform_from_bits(bits[0]) < alpha
    return alpha >= material.cutoff


@wp.func
def intersect_solid(
    scene: RayScene, shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, sided: wp.bool
) -> Contact:
    """Return the ``Contact`` with the closest triangle of a mesh that stops a ray; ``MOST_LAYERS`` may let it pass.

    A ray continues a little behind a face that it passed, by more than rounding, so that it does not meet the same face
    again.
    """
    found = Contact()
    found.t = FAR
    step = 64.0 * ROUNDING * wp.length(shape.extent) / wp.length(direction)
    start = float(0.0)
    layer = wp.int32(0)
    while layer < MOST_LAYERS and start < t_max:
        contact = intersect_mesh(shape, origin + start * direction, direction, t_max - start)
        if contact.t >= t_max - start:
            layer = MOST_LAYERS
        else:
            contact.t += start
            if is_there(scene, shape, contact, origin, direction, sided):
                found = contact
                layer = MOST_LAYERS
            start = contact.t * (1.0 + 8.0 * ROUNDING) + step
        layer += 1
    return found


@wp.func
def bumped(scene: RayScene, shape: Shape, hit: Hit, normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Return the unit normal of a mesh in its own coordinates, tilted by its normal map if there is one."""
    index = shape.material
    if scene.triangle_materials.shape[0] > 0:
        index += scene.triangle_materials[hit.corner / 3]
    material = scene.materials[index]
    if material.normal_texture < 0 or scene.vertex_tangents.shape[0] == 0:
        return normal
    frames = scene.vertex_tangents
    corner = hit.corner
    w = 1.0 - hit.weights[0] - hit.weights[1]
    frame = hit.weights[0] * frames[corner] + hit.weights[1] * frames[corner + 1] + w * frames[corner + 2]
    tangent = wp.vec3(frame[0], frame[1], frame[2])
    tangent -= wp.dot(tangent, normal) * normal
    length = wp.length(tangent)
    if length < 1.0e-6:
        return normal
    tangent = tangent / length
    bitangent = wp.where(frame[3] < 0.0, -1.0, 1.0) * wp.cross(normal, tangent)
    cosine = wp.dot(normal, wp.normalize(direction))
    width = scene.pixel_spread * hit.t * slant(cosine)
    point = point_of_triangle(scene, corner, hit.weights, hit.uv, width, shape.scale)
    texel = sample_texture(scene, material.normal_texture, point)
    x = material.normal_scale * (2.0 * texel[0] - 1.0)
    y = material.normal_scale * (2.0 * texel[1] - 1.0)
    tilted = x * tangent + y * bitangent + (2.0 * texel[2] - 1.0) * normal
    size = wp.length(tilted)
    if size < 1.0e-6:
        return normal
    return tilted / size
