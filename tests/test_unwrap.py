import cv2
import numpy as np
import pytest
import trimesh
import warp as wp

from tests.error_model import check_error
from tests.kernel_rig import records, trace_of
from tests.twins import latlong as latlong_reference
from tests.twins import unwrap as reference
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.environment import fill, unwrap
from warp_ar.kernels.structs import (
    BOX,
    MESH,
    FrameParams,
    Material,
    Probe,
    RayScene,
    Shape,
    Texture,
    make_environment_view,
)

# Float32 directions and unit vectors: a few roundings of 6e-8 each.
NORMAL = 2e-6
# A pixel coordinate of up to 400, computed from those: 400 * a few roundings.
PIXEL = 1e-3
# What a shift of PIXEL does to a bilinear sample of a picture of noise (slope 1 per pixel at most), divided by the
# reflectance.
SAMPLE = 2 * PIXEL

CENTER, RADIUS, REFLECTANCE = (0.1, -0.05, 0.035), 0.035, (0.85, 0.8, 0.9)
HEIGHT = 32


def look(distance=0.5, **more):
    return reference.View((0.1 + 0.3 * distance, -0.05 - 0.8 * distance, 0.035 + 0.5196 * distance), CENTER, **more)


def make_params(view):
    place = {"camera_position": view.position, "world_from_camera": view.rotation}
    lens = {"focal": view.focal, "principal": view.principal, "distortion": view.distortion}
    return records(FrameParams, {**place, **lens})


def make_probes(balls):
    return records(Probe, *({"center": c, "radius": r, "reflectance": rho} for c, r, rho in balls))


def make_scene(shapes=()):
    scene = RayScene()
    scene.proxies = records(Shape, *({"rotation": np.eye(3), "scale": 1.0, **shape} for shape in shapes))
    scene.objects = wp.zeros(0, dtype=Shape)
    scene.materials, scene.textures = wp.zeros(0, dtype=Material), wp.zeros(0, dtype=Texture)
    scene.texels, scene.vertex_normals = wp.zeros(0, dtype=wp.uint32), wp.zeros(0, dtype=wp.vec3)
    scene.vertex_uvs = wp.zeros(0, dtype=wp.vec2)
    return scene


BALL = (CENTER, RADIUS, REFLECTANCE)


def project(view, balls=(BALL,), shapes=(), height=HEIGHT):
    kinds = trace_of((), shapes).proxies
    corners = wp.zeros((height + 1, 2 * height + 1, len(balls)), dtype=wp.vec3)
    rays = wp.array(view.rays().astype(np.float32), dtype=wp.vec2)
    unwrap.project_corners(kinds, make_params(view), make_probes(balls), rays, make_scene(shapes), corners)
    return corners


def unwrapped(
    view,
    frame,
    balls=(BALL,),
    *,
    shapes=(),
    height=HEIGHT,
    transfer="srgb",
    rows=None,
    own=unwrap.ALL_ALIKE,
):
    corners = project(view, balls, shapes, height)
    radiance = wp.full((height, 2 * height), wp.vec3(-1.0), dtype=wp.vec3)
    confidence = wp.full((height, 2 * height), -1.0, dtype=wp.float32)
    clipped = wp.full((height, 2 * height), wp.vec3(-1.0), dtype=wp.vec3)
    table = wp.array(decode_table(transfer), dtype=wp.vec3)
    frame = wp.array(np.ascontiguousarray(frame), dtype=wp.vec3ub)
    for band in rows or [None]:
        view = make_environment_view(radiance, confidence, clipped)
        unwrap.gather_probe(False, frame, table, make_probes(balls), corners, own, view, rows=band)
    return radiance.numpy(), confidence.numpy(), clipped.numpy()


def encode(linear):
    """Codes of the linear transfer."""
    return np.rint(np.clip(linear, 0, 1) * 255).astype(np.uint8)


def constant_frame(view, code):
    return np.full((view.height, view.width, 3), code, np.uint8)


def smooth_light(d):
    """Every channel its own ramp; the same on both sides of the seam, different at the poles."""
    return 0.45 + 0.35 * d


@wp.kernel(enable_backward=False)
def normal_kernel(distance: wp.array[wp.float32], psi: wp.array[wp.vec2], normal_out: wp.array[wp.vec2]):
    i = wp.tid()
    normal_out[i] = unwrap.reflecting_normal(distance[i], psi[i][0], psi[i][1])


# ---- closed form ----


@pytest.mark.parametrize("distance", [1.01, 1.2, 2.0, 5.7, 20.0, 1e3, 1e5])
def test_normals_reflect_every_direction_to_the_camera(device, distance):
    """From straight back (psi = 0) to the edge of the blind cone."""
    psi = np.concatenate([np.linspace(0, 1, 2001) ** 2, [1e-7, 1e-4]]) * reference.blind_angle(distance) * (1 - 1e-6)
    given = np.stack([np.cos(psi), np.sin(psi)], -1).astype(np.float32)
    out = wp.zeros(len(psi), dtype=wp.vec2)
    inputs = [wp.full(len(psi), distance, dtype=wp.float32), wp.array(given, dtype=wp.vec2)]
    wp.launch(normal_kernel, len(psi), inputs, [out])
    n = out.numpy().astype(np.float64)
    # Compared as what they reflect: at D = 1.01 that turns 102 times faster than the normal, so its error is what
    # counts there.
    slope = 2 + 1 / (distance - 1)
    got = reference.reflected_angle(np.arctan2(n[:, 1], n[:, 0]), np.float64(np.float32(distance)))
    np.testing.assert_allclose(got, np.arctan2(given[:, 1], given[:, 0]), atol=NORMAL * slope)


# ---- twin ----


@pytest.mark.parametrize("distortion", [(0.0,) * 8, (0.12, -0.2, 0.003, -0.002, 0.05, 0.01, 0.02, 0.0)])
def test_corners_match_twin(device, distortion):
    view = look(0.3, distortion=distortion)
    got = project(view).numpy()[:, :, 0].astype(np.float64)
    expected = reference.corners(view, CENTER, RADIUS, HEIGHT)
    blind = np.isnan(expected[..., 2])
    assert blind.any()
    assert (got[blind, 2] == -1).all()
    assert (got[~blind, 2] >= 0).all()
    np.testing.assert_allclose(got[~blind], expected[~blind], atol=PIXEL)
    check_error("unwrap", got[~blind], expected[~blind])


def test_gather_matches_twin(device):
    """On noise, which forgives no wrong pixel. A sample exactly between two pixels may go to either in ``nearest``."""
    view = look(0.35, size=(200, 150), focal=280.0)
    frame = np.random.default_rng(6).integers(0, 256, (150, 200, 3)).astype(np.uint8)
    got = unwrapped(view, frame, height=16, transfer="linear")
    expected = reference.gather(
        frame,
        decode_table("linear"),
        REFLECTANCE,
        reference.corners(view, CENTER, RADIUS, 16),
        unwrap.RIM_START,
        unwrap.RIM_WIDTH,
    )
    agree = np.abs(got[0] - expected[0]).max(-1) < SAMPLE
    assert agree.mean() > 0.999
    check_error("unwrap", got[0][agree], expected[0][agree])
    np.testing.assert_allclose(got[1], expected[1], atol=SAMPLE)
    assert (np.abs(got[2] - expected[2]).max(-1) < SAMPLE).mean() > 0.995


# ---- rendered balls ----


@pytest.mark.parametrize("distance", [0.15, 0.5, 2.0])
def test_ramp_is_where_it_belongs(device, distance):
    """Hard cases 2 and 4: seam, poles and perspective. One texel of shift would be 0.035, an orthographic map 0.06 at
    0.15 m."""
    view = look(distance, focal=min(0.8 * 110 * distance / RADIUS, 900.0), size=(400, 400))
    frame = encode(reference.render(view, [BALL], smooth_light, lambda d: np.ones_like(d)))
    radiance, confidence, _ = unwrapped(view, frame, transfer="linear")
    expected = smooth_light(latlong_reference.directions(HEIGHT, 2 * HEIGHT))
    sure = confidence > 0.5
    assert sure.mean() > 0.6
    error = np.abs(radiance - expected)[sure]
    # Half a code over the reflectance; the picture's own pixels near the rim.
    assert error.mean() < 0.003
    assert error.max() < 0.02
    # Nothing leans to one side.
    assert np.abs((radiance - expected)[sure].mean(0)).max() < 0.0015


@pytest.mark.parametrize("distance", [0.25, 0.6])
@pytest.mark.parametrize("background", [0.0, 1.0])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.35, -0.35)])
def test_nothing_of_the_background_bleeds_in(device, distance, background, shift):
    """Hard case 1: a grey ball before black or white, its outline known to half a pixel: grey to the bit wherever
    trusted."""
    true = look(distance, focal=500.0)
    frame = encode(
        reference.render(
            true, [BALL], lambda d: np.full_like(d, 0.5) / REFLECTANCE, lambda d: np.full_like(d, background)
        )
    )
    center = true.principal
    tracked = look(distance, focal=500.0, principal=(center[0] + shift[0], center[1] + shift[1]))
    radiance, confidence, _ = unwrapped(tracked, frame, transfer="linear")
    seen = confidence > 0
    assert seen.mean() > 0.7
    assert np.ptp(radiance[seen], axis=0).max() == 0.0


def test_light_is_a_mean_over_the_footprint(device):
    """A checker of single pixels has mean one half: it is seen where texels cover many pixels."""
    view = look(0.2, focal=700.0, size=(400, 400))
    checker = (np.indices((400, 400)).sum(0) % 2 * 255).astype(np.uint8)
    frame = np.repeat(checker[..., None], 3, -1)
    ball = (CENTER, RADIUS, (1.0, 1.0, 1.0))
    radiance, confidence, clipped = unwrapped(view, frame, [ball], transfer="linear", height=16)
    sure = (confidence > 0.9) & (np.abs(np.arange(16) - 7.5) < 6)[:, None]
    assert clipped[sure].mean() == pytest.approx(0.5, abs=0.06)
    assert radiance[sure].mean() == pytest.approx(0.5, abs=0.06)
    # One sample between four pixels at random, 1/2 (1 - 2x)(1 - 2y), would have a standard deviation of 1/6.
    assert radiance[sure].std() < 0.05


# ---- what is not seen ----


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_hidden_by_a_proxy(device, kind):
    """A white object before the ball hides part of it, and none of its white gets in, not even along its edges."""
    view = look(0.4, focal=500.0)
    half, at, mesh = np.array([0.02, 0.004, 0.02]), np.array([0.14, -0.21, 0.13]), None
    shape = {"kind": BOX, "position": at, "extent": half}
    if kind == "mesh":
        box = trimesh.creation.box(2 * half)
        # Corners one after another, as ``structs.Shape.mesh`` has them.
        vertices = np.float32(box.vertices[box.faces]).reshape(-1, 3)
        mesh = wp.Mesh(wp.array(vertices, dtype=wp.vec3), wp.array(np.arange(len(vertices)), dtype=wp.int32))
        shape |= {"kind": MESH, "mesh": mesh.id}
    frame = encode(
        reference.render(view, [BALL], lambda d: np.full_like(d, 0.5) / REFLECTANCE, lambda d: np.full_like(d, 0.5))
    )
    # Painted over the ball: the hull of its corners.
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + at
    pixels, _ = view.project(corners)
    hull = cv2.convexHull(np.rint(pixels * 16).astype(np.int32))
    frame = cv2.fillConvexPoly(frame.copy(), hull, (255, 255, 255), cv2.LINE_AA, 4)
    free = unwrapped(view, frame, transfer="linear")
    radiance, confidence, _ = unwrapped(view, frame, shapes=[shape], transfer="linear")
    seen = confidence > 0
    grey = free[0][(free[1] > 0.9)].min(0)
    assert free[0][free[1] > 0].max() > 1.0  # it does stand in the way
    assert 0.2 < seen.sum() / (free[1] > 0).sum() < 0.95
    assert np.abs(radiance[seen] - grey).max() < 1e-6
    assert (confidence[seen] == free[1][seen]).all()


def test_of_several_balls_the_one_that_sees_speaks(device):
    """The nearer ball hides part of the other; together they know more than either, and agree with the light."""
    other = ((0.16, -0.16, 0.035), 0.02, (0.5, 0.6, 0.7))
    view = look(0.4, focal=500.0)
    frame = encode(reference.render(view, [BALL, other], smooth_light, np.ones_like))
    both = unwrapped(view, frame, [BALL, other], transfer="linear")
    single = [unwrapped(view, frame, [ball], transfer="linear") for ball in (BALL, other)]
    assert (both[1] <= np.maximum(single[0][1], single[1][1]) + 1e-6).all()
    sure = both[1] > 0.5
    error = np.abs(both[0] - smooth_light(latlong_reference.directions(HEIGHT, 2 * HEIGHT)))[sure]
    assert error.max() < 0.04
    order = unwrapped(view, frame, [other, BALL], transfer="linear")
    np.testing.assert_allclose(order[0], both[0], atol=1e-6)


def two_balls_that_disagree():
    """The larger one shows white, the smaller one black."""
    large, small = ((0.0, -0.1, 0.0), 0.06, (1.0, 1.0, 1.0)), ((0.0, 0.1, 0.0), 0.015, (1.0, 1.0, 1.0))
    view = reference.View((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), focal=900.0)
    frame = constant_frame(view, 0)
    frame[:, : view.width // 2] = 255 if view.project([large[0]])[0][0, 0] < view.width / 2 else 0
    frame[:, view.width // 2 :] = 255 - frame[:, :1]
    return view, frame, large, small


def test_balls_vote_by_their_pixels(device):
    """Of two balls that disagree, the one with 16 times the pixels has 16 votes to 1, whatever their order."""
    view, frame, large, small = two_balls_that_disagree()
    for balls in ([large, small], [small, large]):
        radiance, confidence, _ = unwrapped(view, frame, balls, transfer="linear")
        sure = confidence > 0.98
        both = sure & (unwrapped(view, frame, [small], transfer="linear")[1] > 0.9)
        assert both.sum() > 200
        # The balls are seen 12 degrees apart: their densities differ by a few percent more.
        assert np.median(radiance[both]) == pytest.approx(16 / 17, abs=0.01)


def test_in_a_balls_own_map_others_tell_of_what_it_does_not_see(device):
    """Its light wherever it has a say, whatever the other one's pixels; the other's in its blind cone."""
    view, frame, large, small = two_balls_that_disagree()
    alone = {ball: unwrapped(view, frame, [ball], transfer="linear") for ball in (large, small)}
    for balls, own, light in (([large, small], 1, 0.0), ([small, large], 0, 0.0), ([small, large], 1, 1.0)):
        radiance, confidence, _ = unwrapped(view, frame, balls, transfer="linear", own=own)
        mine, other = alone[balls[own]][1], alone[balls[1 - own]][1]
        # A vote of the other one counts a thousandth, 16 times as many pixels 16 of those.
        assert np.abs(radiance[mine > 0.9] - light).max() < 0.02
        borrowed = (mine == 0.0) & (other > 0.5)
        assert borrowed.sum() > 20 or balls[own] is large  # which sees all that the small one does
        np.testing.assert_array_equal(radiance[borrowed], alone[balls[1 - own]][0][borrowed])
        np.testing.assert_array_equal(confidence, np.maximum(mine, other))


def test_a_lens_that_folds_over_shows_nothing_twice(device):
    """Barrel distortion of k1 = -0.5 turns back at 55 degrees; a ball beyond that is not in the frame, whatever the
    formula says."""
    lens = (-0.5, 0, 0, 0, 0, 0, 0, 0)
    view = reference.View((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), distortion=lens, focal=150.0)
    beyond = np.radians(54.0)
    ball = ((0.4 * np.cos(beyond), 0.4 * np.sin(beyond), 0.0), 0.035, (1.0, 1.0, 1.0))
    pixels, _ = view.project([ball[0]])
    assert 0 <= pixels[0, 0] < view.width  # the formula alone would find it
    assert (unwrapped(view, constant_frame(view, 50), [ball])[1] == 0).all()


# ---- real and path-traced pictures ----


def filled(radiance, confidence):
    height, width = confidence.shape
    levels = wp.zeros(fill.fill_level_offsets(height, width)[-1], dtype=wp.vec4)
    out = wp.zeros((height, width), dtype=wp.vec3)
    fill.seed_fill(wp.array(radiance, dtype=wp.vec3), wp.array(confidence, dtype=wp.float32), levels)
    fill.push_pull(levels, height, width)
    fill.finish_fill(levels, out)
    return out


@pytest.mark.parametrize("number", [7])
def test_light_directions_of_real_photographs(device, shared, number):
    """The brightest part of what a photographed chrome ball shows is within one degree of its lamp as published."""
    folder = shared / "real" / "chrome_balls" / "LightProbe-1"
    x, y, radius = map(float, (folder / "circle_data.txt").read_text().split())
    expected = np.loadtxt(folder / "light_directions.txt")[:, number - 1]
    image = cv2.cvtColor(cv2.imread(str(folder / f"Image_{number:02d}.JPG")), cv2.COLOR_BGR2RGB)
    # Photographed from so far that it is orthographic: 1000 radii. World: x right, y up, z toward the camera. Their
    # origin is the picture's corner, half a pixel from the centre of its first pixel.
    distance = 1000.0
    rows, columns = image.shape[:2]
    focal = radius * np.sqrt(distance**2 - 1.0)
    view = reference.View((0, 0, distance), (0, 0, 0), (columns, rows), focal, principal=(x - 0.5, rows - 0.5 - y))
    view.rotation = np.diag([1.0, -1.0, -1.0])
    radiance, confidence, _ = unwrapped(view, image, [((0.0, 0.0, 0.0), 1.0, (1.0, 1.0, 1.0))], height=64)
    brightness = filled(radiance, confidence).numpy().mean(-1)
    core = np.where(brightness > 0.9 * brightness.max(), brightness, 0.0) * latlong_reference.solid_angles(
        *brightness.shape
    )
    toward = np.einsum("hw,hwc->c", core, latlong_reference.directions(*brightness.shape))
    cosine = toward @ expected / np.linalg.norm(toward) / np.linalg.norm(expected)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.0
