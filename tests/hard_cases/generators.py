"""Nasty inputs: frames, environments, meshes, lights and directions that have broken renderers before."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warp_ar.scene.geometry import Mesh

TINY = float(np.float32(1e-40))
"""A denormal float32."""
SUN, SKY = 1e6, 1e-4
"""Hard case 6: radiance of a one-texel sun and of the sky around it."""

# --- Frames -----------------------------------------------------------------------------------------------------------


def frames(rows: int, columns: int) -> dict[str, np.ndarray]:
    """8-bit frames by name, (rows, columns, 3)."""
    rng = np.random.default_rng(0)
    grey = np.full((rows, columns, 3), 128, np.uint8)
    one = 0 * grey
    one[rows // 2, columns // 2] = 255
    half = grey.copy()
    half[: rows // 2] = 255
    torn = rng.integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    torn[rows // 2 :] = np.roll(torn[rows // 2 :], columns // 3, axis=1)
    ramp = np.broadcast_to(np.linspace(0, 255, columns).astype(np.uint8)[None, :, None], grey.shape).copy()
    checks = np.where((np.indices((rows, columns)).sum(0) % 2)[..., None], 255, 0).astype(np.uint8)
    return {
        "black": 0 * grey,
        "white": 0 * grey + 255,
        "grey": grey,
        "just below clipping": 0 * grey + 254,
        "one saturated pixel": one,
        "top half saturated": half,
        "noise": rng.integers(0, 256, grey.shape, dtype=np.uint8),
        "torn": torn,
        "ramp": ramp,
        "checkers": np.broadcast_to(checks, grey.shape).copy(),
        "one channel clipped": grey + np.array([127, 0, 0], np.uint8),
    }


# --- Maps -------------------------------------------------------------------------------------------------------------


def finite_maps(rows: int, columns: int) -> dict[str, np.ndarray]:
    """Radiance maps, finite and not negative, that an environment can have: float32 (rows, columns, 3)."""
    rng = np.random.default_rng(1)
    sky = np.full((rows, columns, 3), SKY, np.float32)

    def lamp(row: int, column: int, radiance: float = SUN) -> np.ndarray:
        made = sky.copy()
        made[row, column] = radiance
        return made

    opposite = lamp(rows // 2, 0)
    opposite[rows - 1 - rows // 2, columns // 2] = SUN
    return {
        "black": 0.0 * sky,
        "sun": lamp(rows // 3, columns // 5),
        "sun at the pole": lamp(0, 0),
        "sun at the seam": lamp(rows // 2, columns - 1),
        "two equal opposite suns": opposite,
        "one outlier of 1e8": lamp(rows // 2, columns // 2, 1e8),
        "denormal": np.full_like(sky, TINY),
        "1e-8": np.full_like(sky, 1e-8),
        "1e8": np.full_like(sky, 1e8),
        "uniform": np.full_like(sky, 0.5),
        "wide range": (10.0 ** rng.uniform(-8, 8, sky.shape)).astype(np.float32),
        "one coloured channel": np.float32([1.0, 0.0, 0.0]) * rng.random((rows, columns, 1), dtype=np.float32),
    }


def broken_maps(rows: int, columns: int) -> dict[str, np.ndarray]:
    """Maps with what is no radiance, a tenth of their texels each."""
    rng = np.random.default_rng(2)
    base = rng.uniform(0.1, 1.0, (rows, columns, 3)).astype(np.float32)
    made = {}
    for name, value in (("NaN", np.nan), ("Inf", np.inf), ("-Inf", -np.inf), ("negative", -3281.0), ("3e38", 3e38)):
        bad = base.copy()
        bad[rng.random((rows, columns)) < 0.1] = value
        bad[0, 0] = value
        made[name] = bad
    made["NaN everywhere"] = np.full_like(base, np.nan)
    made["negative everywhere"] = np.full_like(base, -1.0)
    return made


# --- Directions -------------------------------------------------------------------------------------------------------


def directions() -> np.ndarray:
    """Unit float32 directions, (n, 3): axes, diagonals, seam, poles and all of them a few ulp to the side."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    signs = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
    diagonal = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    seam = np.array([[-math.sqrt(1 - z * z), e, z] for z in (-0.5, 0.0, 0.5) for e in (-1e-7, 0.0, 1e-7, -0.0)])
    pole = np.array([[x, y, s] for s in (-1.0, 1.0) for x in (0.0, 1e-30, -1e-8) for y in (0.0, -1e-30, 1e-4)])
    exact = np.concatenate([axes, diagonal, seam, pole]).astype(np.float32)
    up, down = np.nextafter(exact, np.float32(np.inf)), np.nextafter(exact, np.float32(-np.inf))
    return np.concatenate([exact, up, down])


# --- Meshes -----------------------------------------------------------------------------------------------------------


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    lengths = np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(
        vertices.astype(np.float32), faces.astype(np.int32), (vertices / np.maximum(lengths, 1e-9)).astype(np.float32)
    )


def closed_sphere(subdivisions: int) -> Mesh:
    """Closed sphere of radius 1: 20 * 4^subdivisions triangles that share all vertices."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array(
        [p for a in (-1, 1) for b in (-golden, golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))]
    ) / math.hypot(1, golden)
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) < 1.1
    faces = np.array(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]]
    )
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    inward = (normals * vertices[faces[:, 0]]).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        edges, inverse = np.unique(
            np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_inverse=True
        )
        middle = vertices[edges].mean(1)
        m = len(vertices) + inverse.reshape(-1, 3)
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        parts = ((a, m[:, 0], m[:, 2]), (b, m[:, 1], m[:, 0]), (c, m[:, 2], m[:, 1]), m.T)
        faces = np.concatenate([np.stack(part, 1) for part in parts])
    return _mesh(vertices, faces)


def spoilt(mesh: Mesh, kind: str) -> Mesh:
    """A closed mesh with something wrong that must not open it.

    Args:
        mesh: Closed.
        kind: ``inverted``, ``half inverted``, ``duplicated``, ``zero area`` or ``shuffled``.
    """
    faces, rng = mesh.faces, np.random.default_rng(3)
    if kind == "inverted":
        faces = faces[:, ::-1]
    elif kind == "half inverted":
        faces = np.where((np.arange(len(faces)) % 2)[:, None] == 1, faces[:, ::-1], faces)
    elif kind == "duplicated":
        faces = np.concatenate([faces, faces[::3, ::-1], faces[::2]])
    elif kind == "zero area":
        point, line = faces[:, [0, 0, 0]], faces[:, [0, 1, 1]]
        faces = np.concatenate([point, faces, line])
    elif kind == "shuffled":
        faces = np.stack(
            [
                np.roll(face, turn)
                for face, turn in zip(faces[rng.permutation(len(faces))], rng.integers(0, 3, len(faces)), strict=True)
            ]
        )
    else:
        raise ValueError(f"kind: no way {kind!r} to spoil a mesh")
    return dataclasses.replace(mesh, faces=np.ascontiguousarray(faces, np.int32))


SPOILT = ("inverted", "half inverted", "duplicated", "zero area", "shuffled")


def rays_at_edges(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on shared edges, every tenth a vertex, and the normals and centres of their faces: (count, 3) each."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    chosen = corners[rng.integers(len(corners), size=count)]
    weight = rng.random((count, 1))
    weight[::10] = 0.0
    normals = np.cross(chosen[:, 1] - chosen[:, 0], chosen[:, 2] - chosen[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return chosen[:, 0] * (1.0 - weight) + chosen[:, 1] * weight, normals, chosen.mean(1)


# --- Lights -----------------------------------------------------------------------------------------------------------


def lights() -> dict[str, dict[str, object]]:
    """Virtual lights of hard case 9, as fields of ``structs.Light``, about the scene of ``rig.make_scene``."""
    from warp_ar.kernels.structs import DIRECTIONAL, POINT, SPOT

    base = {
        "kind": POINT,
        "position": (0.05, 0.02, 0.2),
        "direction": (0, 0, -1),
        "intensity": (1, 1, 1),
        "inner_angle": 0.0,
    }
    base |= {"outer_angle": 0.0, "attenuation": (0, 0, 1), "radius": 0.0}
    spot = {**base, "kind": SPOT}
    return {
        "on the desk": {**base, "position": (0.05, 0.02, 0.0)},
        "on an object": {**base, "position": (0.09, 0.0, 0.06)},
        "inside an object": {**base, "position": (0.09, 0.0, 0.03)},
        "behind every surface": {**base, "position": (0.0, 0.0, -1.0)},
        "at the camera": {**base, "position": (0.02, -0.3, 0.35)},
        "cone 0": spot,
        "cone 90": {**spot, "inner_angle": math.pi / 2, "outer_angle": math.pi / 2},
        "inner = outer": {**spot, "inner_angle": 0.4, "outer_angle": 0.4},
        "colour 0": {**base, "intensity": (0, 0, 0)},
        "1e6": {**base, "intensity": (1e6, 1e6, 1e6)},
        "1e6 on the desk": {**base, "position": (0.05, 0.02, 0.0), "intensity": (1e6, 1e6, 1e6)},
        "1e-8": {**base, "intensity": (1e-8, 1e-8, 1e-8)},
        "wide, half sunk into the desk": {**base, "position": (0.05, 0.02, 0.0), "radius": 0.03},
        "so wide that it holds the scene": {**base, "radius": 3.0},
        "as small as a number can be": {**base, "radius": TINY},
        "no falloff at all": {**base, "attenuation": (0, 0, 0)},
        "grazing sun": {**base, "kind": DIRECTIONAL, "direction": (1, 0, 0)},
        "sun from below": {**base, "kind": DIRECTIONAL, "direction": (0, 0, 1)},
    }


DARK_LIGHTS = ("colour 0", "behind every surface", "sun from below")
"""Lights that add nothing to the desk."""
