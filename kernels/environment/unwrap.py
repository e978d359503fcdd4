"""Unwrapping of the mirror ball: the latlong map of the light that arrives at it from every direction.

The environment is taken to be distant: the light from direction d is the same everywhere on the ball. Seen from the
ball's centre, with the axis a toward the camera and D = distance / radius, the ball's point with normal n at angle
theta from a (in the plane of a and d) looks at the camera along v = (D a - n) / |D a - n|, at angle beta = atan2(sin
theta, D - cos theta) on the other side of the axis, and so reflects light that arrives from the angle

    f(theta) = 2 theta + beta(theta),    f'(theta) = 2 + (D cos theta - 1) / |D a - n|^2,

which is theta + atan2(D sin theta, D cos theta - 1) written without the difference of two nearly equal numbers. On the
visible cap, 0 <= theta <= acos(1 / D), f rises from 0 to acos(1 / D) + pi / 2 and is concave, so Newton's method finds
theta for a given d; directions beyond are in the blind cone behind the ball. The iteration turns n by e / f', where e,
the remaining angle, is the cross product of the reflected direction and d. It needs square roots only, and does not
divide by the sine of an angle that can be zero (light that returns straight to the camera).

The point is then projected through the lens into the frame. This is done at the texels' corners. Samples within a texel
are placed by bilinear interpolation between its corners, as many as its footprint is long in pixels, so that every
pixel of the ball is used.

Confidence is 0 for directions that the frame does not show (in the blind cone, outside the frame, hidden by a proxy or
another ball), and within ``RIM_START`` pixels of the silhouette, where light from behind the ball could leak in. It
rises over the next ``RIM_WIDTH`` pixels. It is scaled by density / (density + ``HALF_DENSITY``), with the density of
pixels per steradian.
"""

import functools

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.color import decode, is_saturated, saturation_codes
from warp_ar.kernels.latlong import PI, direction_from_latlong, texel_solid_angle
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.pixels import clip_levels, is_at_clipping, keep_linear
from warp_ar.kernels.rays.shapes import FAR, intersect_box, intersect_plane, meets_mesh, to_rigid_point, to_rigid_vector
from warp_ar.kernels.structs import BOX, MESH, PLANE, EnvironmentView, FrameParams, Probe, RayScene

wp.set_module_options({"enable_backward": False})

RIM_START = wp.constant(2.5)
"""Pixels from the silhouette at which confidence starts. Along a diagonal a bilinear sample reaches 1.4 pixels and the
pixel it finds there spreads over another 0.7; the rest is for the tracked outline, which errs by about half a pixel."""
RIM_WIDTH = wp.constant(1.5)
"""Pixels over which confidence rises to its full value, beyond ``RIM_START``."""

ALL_ALIKE = -1
"""Value of ``gather_probe``'s argument ``own`` that makes one map from all balls."""
BORROWED = wp.constant(wp.float32(1.0e-3))
"""Factor on the weight of one ball's pixels in the map of another ball."""

MAX_SAMPLES = wp.constant(8)  # per side of a texel
HALF_DENSITY = wp.constant(wp.float32(4.0))  # pixels per steradian: a ball of 8 pixels across
NEWTON_STEPS = wp.constant(12)  # 2 to 4 are taken from half a metre; more only where the camera almost touches the ball
CONVERGED = wp.constant(wp.float32(1.0e-7))  # squared angle: 0.02 degrees, which the step then taken squares once more
FOLD_TOLERANCE = wp.constant(wp.float32(3.0))  # pixels
CONTACT = wp.constant(wp.float32(0.02))  # radii: a surface that touches the ball does not hide the point of contact


@wp.func
def reflecting_normal(distance: wp.float32, cos_psi: wp.float32, sin_psi: wp.float32) -> wp.vec2:
    """Return the normal (along the axis, across it) of the ball's point that reflects light from angle psi.

    Args:
        distance: From the ball's centre to the camera, in radii; above 1.
        cos_psi: Cosine of the angle between the light's direction and the axis toward the camera.
        sin_psi: Its sine, not negative.

    Returns:
        Unit vector in the plane of both; meaningful only outside the blind cone.
    """
    least = 1.0 / distance  # cos theta at the silhouette
    # Both angles near the axis: theta = psi (D - 1) / (2 D - 1), the exact slope of f there.
    share = (distance - 1.0) / (2.0 * distance - 1.0)
    n = wp.normalize(wp.vec2(1.0 - share + share * cos_psi, share * sin_psi))
    if cos_psi < 0.0:
        n = wp.normalize(wp.vec2(1.0 + cos_psi, sin_psi))
    for _step in range(NEWTON_STEPS):
        if n[0] < least:
            n = wp.vec2(least, wp.sqrt((1.0 - least) * (1.0 + least)))
        toward = wp.vec2(distance - n[0], -n[1])
        length_squared = wp.dot(toward, toward)
        v = toward / wp.sqrt(length_squared)
        r = 2.0 * wp.dot(n, v) * n - v
        missing = r[0] * sin_psi - r[1] * cos_psi
        if r[0] * cos_psi + r[1] * sin_psi < 0.0:
            missing = wp.sign(missing)  # more than a right angle
        turn = missing / (2.0 + (distance * n[0] - 1.0) / length_squared)
        n = wp.normalize(wp.vec2(n[0] - turn * n[1], wp.max(n[1] + turn * n[0], 0.0)))
        if missing * missing < CONVERGED:
            break
    return n


@wp.func
def any_perpendicular(axis: wp.vec3) -> wp.vec3:
    """Return some unit vector perpendicular to a unit vector."""
    other = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(axis[0]) > 0.6:
        other = wp.vec3(0.0, 1.0, 0.0)
    return wp.normalize(wp.cross(axis, other))


@functools.cache
def make_hidden_by_proxies(kinds: tuple[int, ...]) -> wp.Function:
    """Return the function ``hidden_by_proxies(scene, origin, ray, t_max, pad) -> bool``: a proxy hides a ball's point.

    Proxies are enlarged by ``pad`` metres, the rim's width: pixels right beside a proxy may show it.
    """

    @wp.func(name=f"hidden_by_proxies_{'_'.join(map(str, kinds))}", module="unique")
    def hidden_by_proxies(
        scene: RayScene, origin: wp.vec3, ray: wp.vec3, t_max: wp.float32, pad: wp.float32
    ) -> wp.bool:
        for index in range(scene.proxies.shape[0]):
            shape = scene.proxies[index]
            o = to_rigid_point(shape, origin)
            d = to_rigid_vector(shape, ray)
            half = shape.extent + wp.vec3(1.0, 1.0, 1.0) * (pad / shape.scale)
            if wp.static(PLANE in kinds):
                if shape.kind == PLANE:
                    if intersect_plane(half, o, d, t_max) < FAR:
                        return True
            if wp.static(BOX in kinds):
                if shape.kind == BOX:
                    if intersect_box(half, o, d, t_max) < FAR:
                        return True
            if wp.static(MESH in kinds):
                if shape.kind == MESH:
                    if meets_mesh(shape, o, d, t_max):
                        return True
                    # A mesh cannot be enlarged: four rays around this one test it instead.
                    across = any_perpendicular(wp.normalize(d)) * (pad / shape.scale)
                    up = wp.cross(wp.normalize(d), across)
                    if meets_mesh(shape, o, d + across, t_max) or meets_mesh(shape, o, d - across, t_max):
                        return True
                    if meets_mesh(shape, o, d + up, t_max) or meets_mesh(shape, o, d - up, t_max):
                        return True
        return False

    return hidden_by_proxies


@wp.func
def is_folded(camera: FrameParams, rays: wp.array2d[wp.vec2], point: wp.vec3, at: wp.vec3) -> wp.bool:
    """Return whether the ray of the pixel onto which a point is projected does not lead back to the point.

    A polynomial lens model gives such false projections beyond its field of view. Outside the frame nothing is tested.

    Args:
        camera: Camera of the frame.
        rays: Rays of its pixels.
        point: Point relative to the camera, in world axes.
        at: Column and row of its projection.
    """
    i = wp.int32(wp.round(wp.clamp(at[1], 0.0, wp.float32(rays.shape[0] - 1))))
    j = wp.int32(wp.round(wp.clamp(at[0], 0.0, wp.float32(rays.shape[1] - 1))))
    if wp.abs(at[1] - wp.float32(i)) < 1.0 and wp.abs(at[0] - wp.float32(j)) < 1.0:
        p = wp.transpose(camera.world_from_camera) * point
        off = wp.cw_mul(wp.vec2(p[0] / p[2], p[1] / p[2]) - rays[i, j], camera.focal)
        return wp.length(off) > FOLD_TOLERANCE
    return False


@wp.func
def hidden_by_balls(
    probes: wp.array[Probe], own: wp.int32, origin: wp.vec3, point: wp.vec3, t_max: wp.float32, pad: wp.float32
) -> wp.bool:
    """Return whether a ball other than ``own`` comes within ``pad``, in metres, of the ray to a point up to ``t_max``.

    ``point`` is relative to the ray's origin.
    """
    reach = wp.length(point)
    for other in range(probes.shape[0]):
        if other != own:
            o = origin - probes[other].center
            b = -wp.dot(o, point)
            nearest = o + wp.clamp(b / (reach * reach), 0.0, t_max) * point
            if wp.length(nearest) < probes[other].radius + pad:
                return True
    return False


@functools.cache
def make_project_corners_kernel(kinds: tuple[int, ...]) -> wp.Kernel:
    """Return a kernel for scenes with proxies of these kinds, which can hide a ball: any of PLANE, BOX, MESH."""
    hidden_by_proxies = make_hidden_by_proxies(kinds)

    @wp.kernel(module="unique", enable_backward=False)
    def project_corners_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        probes: wp.array[Probe],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        # Out:
        corners_out: wp.array3d[wp.vec3],
    ):
        band_row, column, index = wp.tid()
        row = row_start + band_row
        height = corners_out.shape[0] - 1
        width = corners_out.shape[1] - 1
        corners_out[row, column, index] = wp.vec3(0.0, 0.0, -1.0)

        camera = params[0]
        probe = probes[index]
        to_camera = camera.camera_position - probe.center
        away = wp.length(to_camera)
        distance = away / probe.radius
        if not distance > 1.0001 or not distance < 1.0e6:
            return  # the camera is inside the ball, or nowhere
        axis = to_camera / away
        light = direction_from_latlong(wp.float32(row), wp.float32(column), height, width)
        cos_psi = wp.dot(light, axis)
        side = light - cos_psi * axis
        sin_psi = wp.length(side)
        least = 1.0 / distance
        rim_sine = wp.sqrt((1.0 - least) * (1.0 + least))
        if cos_psi <= -rim_sine:
            return  # blind cone: psi >= acos(1 / D) + pi / 2
        if sin_psi <= 1.0e-6:  # light returns to the camera: any plane through the axis serves
            side = any_perpendicular(axis)
        side = wp.normalize(side)

        n = reflecting_normal(distance, cos_psi, sin_psi)
        # Relative to the camera from the start: no cancellation far from the world's origin.
        point = probe.radius * (n[0] * axis + n[1] * side) - to_camera
        rim = probe.radius * (least * axis + rim_sine * side) - to_camera
        pixel = project(camera, point)
        edge = project(camera, rim)
        if pixel[2] < 0.01 * probe.radius or edge[2] < 0.01 * probe.radius:
            return  # beside or behind the lens
        margin = wp.length(wp.vec2(edge[0] - pixel[0], edge[1] - pixel[1]))

        if is_folded(camera, rays, point, pixel):
            return

        reach = wp.length(point)
        pad = RIM_START * reach / wp.min(camera.focal[0], camera.focal[1])
        t_max = 1.0 - CONTACT * probe.radius / reach
        if hidden_by_balls(probes, index, camera.camera_position, point, t_max, pad):
            return
        if wp.static(len(kinds) > 0):
            if hidden_by_proxies(scene, camera.camera_position, point, t_max, pad):
                return
        corners_out[row, column, index] = wp.vec3(pixel[0], pixel[1], margin)

    return project_corners_kernel


project_corners = row_launcher(make_project_corners_kernel)
"""Find the pixel in which each ball shows the light from the direction of every texel corner.

Args:
    kinds: Kinds of proxy in the scene.
    params: ``FrameParams`` (1): the camera.
    probes: ``Probe`` (P).
    rays: Undistorted normalised coordinates of the frame's pixel centres, ``wp.vec2`` (frame rows, columns).
    scene: Its proxies can hide the balls.
    corners_out: ``wp.vec3`` (h + 1, w + 1, P): pixel column, pixel row, and pixels from that position to the ball's
        silhouette; the last is -1 where the direction is not seen.
"""


@wp.func
def mix(a: wp.vec3, b: wp.vec3, t: wp.float32) -> wp.vec3:
    """Interpolate from a to b; exact if both are equal."""
    return a + t * (b - a)


@wp.struct
class Texel:
    """Corners of a texel of the environment in the frame, as ``project_corners`` writes them."""

    c00: wp.vec3
    c01: wp.vec3
    c10: wp.vec3
    c11: wp.vec3
    row: wp.int32
    height: wp.int32  # rows of the environment


@wp.struct
class Footprint:
    """Running means over samples of a texel, m += (x - m) w / W.

    They are exact where all x are equal: a constant frame gives a constant map.
    """

    mean: wp.vec3
    clipped: wp.vec3
    total: wp.float32  # weight W
    possible: wp.float32  # weight that all samples would have inside the rim


@wp.func
def footprint_samples(a0: wp.vec3, a1: wp.vec3, b0: wp.vec3, b1: wp.vec3) -> wp.int32:
    """Return the samples along one side of a footprint: one per pixel of the longer of two opposite edges."""
    a = wp.vec2(a1[0] - a0[0], a1[1] - a0[1])
    b = wp.vec2(b1[0] - b0[0], b1[1] - b0[1])
    longest = wp.sqrt(wp.max(wp.dot(a, a), wp.dot(b, b)))
    return wp.int32(wp.clamp(wp.ceil(longest), 1.0, wp.float32(MAX_SAMPLES)))


@functools.cache
def make_average_footprint(linear: bool) -> wp.Function:
    """Return the function ``average_footprint(frame, table, texel) -> Footprint``, the frame's mean over a texel."""
    pixel = wp.vec3 if linear else wp.vec3ub
    to_light = keep_linear if linear else decode
    find_levels = clip_levels if linear else saturation_codes
    clips = is_at_clipping if linear else is_saturated

    @wp.func(module="unique")
    def average_footprint(frame: wp.array2d[pixel], table: wp.array[wp.vec3], texel: Texel) -> Footprint:
        out = Footprint()
        last_row = wp.float32(frame.shape[0] - 1)
        last_column = wp.float32(frame.shape[1] - 1)
        saturation = find_levels(table)
        count_y = footprint_samples(texel.c00, texel.c10, texel.c01, texel.c11)
        count_x = footprint_samples(texel.c00, texel.c01, texel.c10, texel.c11)
        line = wp.int32(-1)
        area = wp.float32(0.0)
        left = wp.vec3(0.0, 0.0, 0.0)
        right = wp.vec3(0.0, 0.0, 0.0)
        for sample in range(count_y * count_x):
            a = sample // count_x
            b = sample % count_x
            if a != line:
                line = a
                y = (wp.float32(a) + 0.5) / wp.float32(count_y)
                # Solid angle of this part of the texel.
                area = wp.sin(PI * (wp.float32(texel.row) + y) / wp.float32(texel.height))
                left = mix(texel.c00, texel.c10, y)
                right = mix(texel.c01, texel.c11, y)
            at = mix(left, right, (wp.float32(b) + 0.5) / wp.float32(count_x))
            out.possible += area
            # Confidence rises from the frame's border as from the rim.
            inside = wp.min(wp.min(at[0], last_column - at[0]), wp.min(at[1], last_row - at[1]))
            ramp = wp.clamp(wp.min(at[2] - RIM_START, inside) / RIM_WIDTH, 0.0, 1.0)
            if inside >= 0.0 and ramp > 0.0:
                weight = area * ramp * ramp * (3.0 - 2.0 * ramp)
                i = wp.int32(at[1])
                j = wp.int32(at[0])
                fy = at[1] - wp.float32(i)
                fx = at[0] - wp.float32(j)
                i1 = wp.min(i + 1, frame.shape[0] - 1)
                j1 = wp.min(j + 1, frame.shape[1] - 1)
                p00 = frame[i, j]
                p01 = frame[i, j1]
                p10 = frame[i1, j]
                p11 = frame[i1, j1]
                top = mix(to_light(table, p00), to_light(table, p01), fx)
                value = mix(top, mix(to_light(table, p10), to_light(table, p11), fx), fy)
                top = mix(clips(p00, saturation), clips(p01, saturation), fx)
                saturated = mix(top, mix(clips(p10, saturation), clips(p11, saturation), fx), fy)
                out.total += weight
                out.mean = mix(out.mean, value, weight / out.total)
                out.clipped = mix(out.clipped, saturated, weight / out.total)
        return out

    return average_footprint


@functools.cache
def make_gather_probe_kernel(linear: bool = False) -> wp.Kernel:
    """Return the kernel of ``gather_probe``, for frames of 8-bit codes or, if ``linear``, of linear radiance."""
    pixel = wp.vec3 if linear else wp.vec3ub
    average_footprint = make_average_footprint(linear)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_probe_kernel(
        # In:
        row_start: wp.int32,
        frame: wp.array2d[pixel],
        table: wp.array[wp.vec3],
        probes: wp.array[Probe],
        corners: wp.array3d[wp.vec3],
        own: wp.int32,
        # Out:
        view_out: EnvironmentView,
    ):
        band_row, column = wp.tid()
        row = row_start + band_row
        width = view_out.radiance.shape[1]
        radiance = wp.vec3(0.0, 0.0, 0.0)
        clipped = wp.vec3(0.0, 0.0, 0.0)
        confidence = wp.float32(0.0)
        votes = wp.float32(0.0)
        texel = Texel()
        texel.row = row
        texel.height = view_out.radiance.shape[0]
        for index in range(probes.shape[0]):
            texel.c00 = corners[row, column, index]
            texel.c01 = corners[row, column + 1, index]
            texel.c10 = corners[row + 1, column, index]
            texel.c11 = corners[row + 1, column + 1, index]
            facing = wp.min(wp.min(texel.c00[2], texel.c01[2]), wp.min(texel.c10[2], texel.c11[2])) >= 0.0
            closest = wp.max(wp.max(texel.c00[2], texel.c01[2]), wp.max(texel.c10[2], texel.c11[2]))
            if facing and closest > RIM_START:
                found = average_footprint(frame, table, texel)
                if found.total > 0.0:
                    across = texel.c11 - texel.c00
                    along = texel.c10 - texel.c01
                    pixels = 0.5 * wp.abs(across[0] * along[1] - across[1] * along[0])
                    density = pixels / texel_solid_angle(row, texel.height, width)
                    certainty = found.total / found.possible * density / (density + HALF_DENSITY)
                    # The ball that shows the direction in more pixels gets more weight.
                    vote = certainty * density
                    if own >= 0 and index != own:
                        vote *= BORROWED
                    votes += vote
                    if votes > 0.0:
                        radiance = mix(radiance, wp.cw_div(found.mean, probes[index].reflectance), vote / votes)
                        clipped = mix(clipped, found.clipped, vote / votes)
                        confidence = wp.max(confidence, certainty)
        view_out.radiance[row, column] = radiance
        view_out.confidence[row, column] = confidence
        view_out.clipped[row, column] = clipped

    return gather_probe_kernel


gather_probe = row_launcher(make_gather_probe_kernel, like=lambda *given: given[-1].radiance)
"""Average the frame over every texel's footprint and undo the ball's reflectance.

Args:
    linear: Whether the frame is linear.
    frame: ``wp.vec3ub`` (frame rows, columns), RGB codes; or ``wp.vec3``, linear radiance.
    decode_table: Linear value of each code, ``wp.vec3`` (256). For a linear frame, (2,): the values from which channels
        count as clipped, alone and beside a clipped channel.
    probes: ``Probe`` (P); reflectances must be positive.
    corners: From ``project_corners``, (h + 1, w + 1, P).
    own: Index of the map's ball; others fill only directions that it does not show. ``ALL_ALIKE``: all balls make one
        map, weighted by their pixels per steradian.
    view_out: (h, w); the mean over every texel's footprint, its confidence, and its clipped share.
"""
