"""Float64 twins of the layers of surfaces: from a scene's description, by ``tests.twins.visibility``."""

import cv2
import numpy as np

from tests.twins.visibility import Body, closest, intersect_sphere


def directions(camera, pose, offsets=(0.0, 0.0)):
    """World directions of all pixels, (H W, 3), their part along the camera's axis 1.

    ``offsets`` are added to the undistorted image coordinates, in pixels.
    """
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    points = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    flat = cv2.undistortPoints(points, camera.matrix(), np.array(camera.distortion), criteria=criteria)[:, 0]
    flat = flat + np.array(offsets) / (camera.fx, camera.fy)
    return np.concatenate([flat, np.ones((len(flat), 1))], -1) @ pose.rotation


def body(one, rotation, position):
    extents = {
        "sphere": lambda: (one.radius, 0.0, 0.0),
        "box": lambda: [0.5 * length for length in one.size],
        "plane": lambda: (*(0.5 * length for length in one.size), 0.0),
    }
    return Body(one.shape, rotation, position, getattr(one, "scale", 1.0), np.array(extents[one.shape]()))


def find(scene, proxy_rotation, pose, seconds, rays):
    """Index, depth, normal toward the camera and place of what every ray meets first, as the picture shows it."""
    eye = -pose.rotation.T @ pose.translation
    origin = np.broadcast_to(eye, rays.shape)
    objects = [body(one, *one.pose_at(seconds)) for one in scene.objects]
    proxies = [body(one, proxy_rotation(one.rotate), np.array(one.at)) for one in scene.proxies]
    t_object, which, normal = closest(objects, origin, rays)
    t_proxy, proxy, proxy_normal = closest(proxies, origin, rays)
    index = np.where((which >= 0) & (t_object <= t_proxy), which, -1)
    depth = np.where(index >= 0, t_object, np.inf)
    normal = np.where(np.sum(normal * rays, -1, keepdims=True) > 0.0, -normal, normal)

    seen, at = np.full(len(rays), -1), np.full(len(rays), np.inf)
    toward = np.zeros_like(rays)
    for k, ball in enumerate(scene.probes):
        t = intersect_sphere(ball.radius, origin - ball.center, rays)
        nearer = t < at
        seen, at = np.where(nearer, len(objects) + len(proxies) + k, seen), np.where(nearer, t, at)
        with np.errstate(invalid="ignore"):
            outward = (origin + np.where(nearer, t, 0.0)[:, None] * rays - ball.center) / ball.radius
        toward = np.where(nearer[:, None], outward, toward)
    before = (proxy >= 0) & (t_proxy < at)
    front = before & (np.sum(proxy_normal * rays, -1) < 0.0)
    seen = np.where(front, len(objects) + proxy, np.where(before, -1, seen))
    at = np.where(front, t_proxy, np.where(before, np.inf, at))
    toward = np.where(front[:, None], proxy_normal, toward)

    physical = index < 0
    index, depth = np.where(physical, seen, index), np.where(physical, at, depth)
    normal = np.where(physical[:, None], toward, normal)
    known = index >= 0
    place = np.where(known[:, None], origin + np.where(known, depth, 0.0)[:, None] * rays, 0.0)
    return index, depth, np.where(known[:, None], normal, 0.0), place


def motion(scene, index, place, pose, seconds, pose_before, seconds_before):
    """Motion in pixels since the frame before, (n, 2)."""
    now, before = place.copy(), place.copy()
    for k, one in enumerate(scene.objects):
        mine = index == k
        rotation, position = one.pose_at(seconds)
        rotation_before, position_before = one.pose_at(seconds_before)
        before[mine] = (place[mine] - position) @ rotation @ rotation_before.T + position_before
    camera = scene.camera

    def pixels(points, pose):
        turn, _ = cv2.Rodrigues(pose.rotation)
        found, _ = cv2.projectPoints(points, turn, pose.translation, camera.matrix(), np.array(camera.distortion))
        return found[:, 0]

    return np.where((index >= 0)[:, None], pixels(now, pose) - pixels(before, pose_before), 0.0)
