"""Float64 twin of ``warp_ar.kernels.environment.unwrap``, and a renderer of mirror balls to unwrap."""

import cv2
import numpy as np

from tests.twins import latlong


def reflected_angle(theta, distance):
    """Angle from the axis of the light that the point at ``theta`` reflects to a camera ``distance`` radii away."""
    return theta + np.arctan2(distance * np.sin(theta), distance * np.cos(theta) - 1.0)


def blind_angle(distance):
    return np.arccos(1.0 / distance) + np.pi / 2.0


def normal_angle(psi, distance):
    """Angle theta with ``reflected_angle(theta) == psi``, by bisection; NaN in the blind cone."""
    psi = np.asarray(psi, np.float64)
    low, high = np.zeros_like(psi), np.full_like(psi, np.arccos(1.0 / distance))
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = reflected_angle(middle, distance) < psi
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.where(psi < blind_angle(distance), 0.5 * (low + high), np.nan)


class View:
    """A camera at ``position`` that looks at ``target``; world z is up."""

    def __init__(self, position, target, size=(320, 240), focal=300.0, distortion=(0.0,) * 8, principal=None):
        self.position = np.asarray(position, np.float64)
        forward = np.asarray(target, np.float64) - self.position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        self.rotation = np.stack([right, np.cross(forward, right), forward], axis=1)  # world_from_camera
        self.width, self.height = size
        self.focal = focal
        self.principal = principal or ((self.width - 1) / 2, (self.height - 1) / 2)
        self.distortion = np.asarray(distortion, np.float64)
        self.matrix = np.array([[focal, 0, self.principal[0]], [0, focal, self.principal[1]], [0, 0, 1.0]])

    def rays(self, columns=None, rows=None):
        """Undistorted normalised coordinates of pixels, (height, width, 2)."""
        if columns is None:
            columns, rows = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        points = np.stack([columns, rows], -1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        flat = cv2.undistortPoints(points, self.matrix, self.distortion, None, None, None, criteria)
        return flat.reshape(*columns.shape, 2)

    def project(self, points):
        """Pixel column and row of world points (n, 3), and their depth."""
        local = (np.asarray(points, np.float64) - self.position) @ self.rotation
        pixels = cv2.projectPoints(local.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.matrix, self.distortion)[0]
        return pixels.reshape(-1, 2), local[:, 2]


def render(view, balls, light, background, samples=4):
    """Linear picture of mirror balls ``(center, radius, reflectance)`` under the distant ``light(directions)``."""
    columns, rows = np.meshgrid(np.arange(view.width, dtype=float), np.arange(view.height, dtype=float))
    picture = np.zeros((view.height, view.width, 3))
    for a in range(samples):
        for b in range(samples):
            shift = (np.array([a, b]) + 0.5) / samples - 0.5
            xy = view.rays(columns + shift[0], rows + shift[1])
            d = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1) @ view.rotation.T
            d /= np.linalg.norm(d, axis=-1, keepdims=True)
            value = background(d)
            nearest = np.full(d.shape[:2], np.inf)
            for center, radius, reflectance in balls:
                o = view.position - np.asarray(center, np.float64)
                b_half = d @ o
                disc = b_half**2 - o @ o + radius**2
                t = np.where(disc >= 0, -b_half - np.sqrt(np.maximum(disc, 0)), np.inf)
                hit = (t > 0) & (t < nearest)
                nearest = np.where(hit, t, nearest)
                n = (o + np.where(hit, t, 0)[..., None] * d) / radius
                r = d - 2.0 * (d * n).sum(-1, keepdims=True) * n
                value = np.where(hit[..., None], light(r) * np.asarray(reflectance), value)
            picture += value
    return picture / samples**2


def corners(view, center, radius, height):
    """Pixel column, pixel row and pixels to the silhouette of each texel corner; NaN where blind. Nothing hides the
    ball."""
    rows, columns = np.meshgrid(np.arange(height + 1.0), np.arange(2 * height + 1.0), indexing="ij")
    d = latlong.directions(height, 2 * height, rows, columns)
    axis = view.position - np.asarray(center, np.float64)
    distance = np.linalg.norm(axis) / radius
    axis /= np.linalg.norm(axis)
    cos_psi = d @ axis
    side = d - cos_psi[..., None] * axis
    sin_psi = np.linalg.norm(side, axis=-1)
    side /= np.maximum(sin_psi, 1e-300)[..., None]
    theta = normal_angle(np.arctan2(sin_psi, cos_psi), distance)
    rim = np.arccos(1.0 / distance)

    def at(angle):
        n = np.cos(angle)[..., None] * axis + np.sin(angle)[..., None] * side
        pixels, _ = view.project((np.asarray(center) + radius * n).reshape(-1, 3))
        return pixels.reshape(*rows.shape, 2)

    seen = at(np.nan_to_num(theta))
    margin = np.linalg.norm(at(np.full_like(theta, rim)) - seen, axis=-1)
    return np.where(np.isfinite(theta)[..., None], np.concatenate([seen, margin[..., None]], -1), np.nan)


def gather(frame, table, reflectance, corner, rim_start, rim_width, half_density=4.0, most=8):
    """Radiance, confidence and clipped share of every texel of one ball."""
    height, width = corner.shape[0] - 1, corner.shape[1] - 1
    area = latlong.solid_angles(height, width)
    radiance, clipped = np.zeros((height, width, 3)), np.zeros((height, width, 3))
    confidence = np.zeros((height, width))
    linear = np.stack([table[frame[..., c], c] for c in range(3)], -1).astype(np.float64)
    full = (frame >= np.where((frame >= 254).any(-1, keepdims=True), 248, 254)).astype(np.float64)

    def fetch(image, x, y):
        i, j = int(y), int(x)
        i1, j1 = min(i + 1, image.shape[0] - 1), min(j + 1, image.shape[1] - 1)
        fy, fx = y - i, x - j
        top = image[i, j] * (1 - fx) + image[i, j1] * fx
        return top * (1 - fy) + (image[i1, j] * (1 - fx) + image[i1, j1] * fx) * fy

    for i in range(height):
        for j in range(width):
            quad = corner[i : i + 2, j : j + 2]
            if np.isnan(quad).any():
                continue
            down = np.linalg.norm(quad[1, :, :2] - quad[0, :, :2], axis=-1).max()
            along = np.linalg.norm(quad[:, 1, :2] - quad[:, 0, :2], axis=-1).max()
            count_y, count_x = (int(np.clip(np.ceil(s), 1, most)) for s in (down, along))
            weights, values, shares, possible = [], [], [], 0.0
            for a in range(count_y):
                y = (a + 0.5) / count_y
                part = np.sin(np.pi * (i + y) / height)
                for b in range(count_x):
                    x = (b + 0.5) / count_x
                    left, right = quad[0, 0] * (1 - y) + quad[1, 0] * y, quad[0, 1] * (1 - y) + quad[1, 1] * y
                    column, row, margin = left * (1 - x) + right * x
                    possible += part
                    inside = min(column, frame.shape[1] - 1 - column, row, frame.shape[0] - 1 - row)
                    ramp = np.clip(min(margin - rim_start, inside) / rim_width, 0, 1)
                    if ramp > 0:
                        weights.append(part * ramp**2 * (3 - 2 * ramp))
                        values.append(fetch(linear, column, row))
                        shares.append(fetch(full, column, row))
            if weights:
                across, other = quad[1, 1, :2] - quad[0, 0, :2], quad[1, 0, :2] - quad[0, 1, :2]
                density = 0.5 * abs(across[0] * other[1] - across[1] * other[0]) / area[i, j]
                radiance[i, j] = np.average(values, axis=0, weights=weights) / reflectance
                clipped[i, j] = np.average(shares, axis=0, weights=weights)
                confidence[i, j] = sum(weights) / possible * density / (density + half_density)
    return radiance, confidence, clipped
