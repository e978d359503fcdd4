"""Float64 twins of ``relight.py`` and ``receiver.py`` for one plane z = 0 as proxy and spheres in the way."""

import numpy as np

from tests.twins import summed_area

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def plane_points(camera, rays, world_from_camera):
    """Where the pixels' rays meet z = 0, (H, W, 3)."""
    directions = np.concatenate([rays, np.ones_like(rays[..., :1])], -1).astype(np.float64) @ world_from_camera.T
    return camera - directions * (camera[2] / directions[..., 2:])


def hidden(points, light, centers, radii):
    """Whether a sphere lies between points and a light, and how near the nearest miss is, relative to the radius."""
    out = np.zeros(points.shape[:-1], bool)
    margin = np.full(points.shape[:-1], np.inf)
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    wi = to_light / distance
    for center, radius in zip(centers, radii, strict=True):
        along = np.clip(((center - points) * wi).sum(-1, keepdims=True), 0.0, distance)
        miss = np.linalg.norm(points + along * wi - center, axis=-1)
        out |= miss < radius
        margin = np.minimum(margin, np.abs(miss / radius - 1.0))
    return out, margin


def point_light(points, light, intensity):
    """Direction to the light, N.L on z = 0 and the irradiance facing it."""
    to_light = light - points
    d2 = (to_light**2).sum(-1, keepdims=True)
    wi = to_light / np.sqrt(d2)
    return wi, np.maximum(wi[..., 2:], 0.0), intensity / d2


def shader_response(n_dot_l, m, alpha):
    return np.maximum((1.0 - alpha) * n_dot_l + alpha * m, 0.0)


def text_response(n_dot_l, m, alpha):
    w = np.minimum(np.abs(alpha), 1.0)
    return (1.0 - w) * n_dot_l + w * np.where(alpha > 0.0, m, 1.0 - m)


READINGS = {
    "paper": ("video", text_response, False),
    "paper_linear": ("linear", text_response, False),
    "paper_shader": ("video", shader_response, False),
    "paper_weighted": ("video", text_response, True),
}
"""Values of the multiplicative factor, blend, whether alpha is weighted."""


def reflectance(radiance, irradiance):
    weight = 0.002 * np.pi
    return np.clip((np.pi * radiance + 0.5 * weight) / (irradiance + weight), 0.0, 1.0)


def respond(method, frame, radiance, n_dot_l, alpha, directionality, surroundings):
    """(Kd, response) of one light, equations of the module's docstring."""
    m = (radiance @ LUMINANCE)[..., None]
    kd = np.full(radiance.shape, 0.5)
    if method == "flat":
        return kd, n_dot_l
    if method in READINGS:
        values, response, weighted = READINGS[method]
        if values == "video":
            m = (summed_area.intensity(frame) / 255.0)[..., None]
        return kd, response(n_dot_l, m, alpha * directionality if weighted else alpha)
    return reflectance(radiance, surroundings), n_dot_l
