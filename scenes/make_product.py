"""Make the product of the scene ``product``: a jar of tea with a printed label, gold print and a ribbed lid.

    python scenes/make_product.py [--out scenes/meshes/jar.glb]

A glTF of two materials. The body has pictures of base colour (the label), of metallic and roughness (its gold print),
and of normals (the print is embossed); the lid is metal by its factors, with a picture of normals for its ribs. trimesh
writes the file, so that what reads it here is not what wrote it.
"""

from __future__ import annotations

import argparse
import pathlib

import cv2
import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

HERE = pathlib.Path(__file__).resolve().parent
SIDES = 64
WIDTH, HEIGHT, FINE = 512, 256, 2
"""Width and height of the label's pictures, pixels. They are drawn ``FINE`` times as large and averaged."""
GLAZE, PAPER, INK, GOLD = (30, 61, 52), (226, 214, 188), (96, 40, 30), (255, 206, 120)
"""Colours of the jar and its label, sRGB codes."""
RIBS = 48

BODY = [(0.0, 0.0), (0.0265, 0.0), (0.028, 0.0015), (0.028, 0.066), (0.0262, 0.0705), (0.022, 0.0725)]
"""(radius, height) of points on the outline of the jar's body, metres; ``LID`` holds those of the lid."""
LID = [(0.022, 0.0725), (0.0245, 0.0725), (0.0245, 0.0875), (0.0235, 0.0885), (0.0, 0.0885)]


def turn_outline(outline: list[tuple[float, float]]) -> tuple[np.ndarray, ...]:
    """Return positions, normals, texture coordinates (v up) and triangles of an outline that is turned about z.

    Every straight piece has normals of its own: edges are sharp.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = np.array(outline)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    positions, normals, uvs, faces = [], [], [], []
    for k in range(len(points) - 1):
        (r0, z0), (r1, z1) = points[k], points[k + 1]
        out = np.array([z1 - z0, r0 - r1]) / np.hypot(z1 - z0, r1 - r0)
        first = 2 * (SIDES + 1) * k
        for radius, height, along in ((r0, z0, length[k]), (r1, z1, length[k + 1])):
            positions.append(np.column_stack([radius * ring, np.full(len(ring), height)]))
            normals.append(np.column_stack([out[0] * ring, np.full(len(ring), out[1])]))
            uvs.append(np.column_stack([angle / (2.0 * np.pi), np.full(len(ring), along / length[-1])]))
        a = first + np.arange(SIDES)
        b, c, d = a + 1, a + SIDES + 2, a + SIDES + 1
        faces += [np.column_stack([a, b, c])] if r0 > 0.0 else []
        faces += [np.column_stack([a, c, d])] if r1 > 0.0 else []
    return np.concatenate(positions), np.concatenate(normals), np.concatenate(uvs), np.concatenate(faces)


def draw_label() -> tuple[np.ndarray, np.ndarray]:
    """Return the label, (256, 512, 3) sRGB codes, and the share of gold in each pixel, (256, 512), 0 to 1."""
    height, width = HEIGHT * FINE, WIDTH * FINE
    colors = np.full((height, width, 3), GLAZE, np.uint8)
    gold = np.zeros((height, width), np.uint8)
    # From bottom to shoulder the wall takes v from 0.26 to 0.89; pictures have their rows from the top.
    top, bottom = int(0.2 * height), int(0.66 * height)
    middle = (top + bottom) // 2
    cv2.rectangle(colors, (0, top), (width, bottom), PAPER, -1)
    for x in range(0, width, width // 16):
        leaf = (x + width // 32, bottom - height // 16)
        cv2.ellipse(colors, leaf, (width // 40, height // 60), 30.0, 0.0, 360.0, INK, -1, cv2.LINE_AA)
    for side in range(3):
        x = side * width // 3 + width // 6
        cv2.circle(gold, (x, middle - height // 24), height // 7, 255, -1, cv2.LINE_AA)
        for k, word in enumerate(("TEA", "No 8")):
            size = 2.0 - k
            wide, tall = cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, size, 3)[0]
            at = (x - wide // 2, middle - height // 24 + (tall // 4 if k == 0 else int(1.9 * tall)))
            cv2.putText(gold, word, at, cv2.FONT_HERSHEY_DUPLEX, size, 0, 3, cv2.LINE_AA)
    for y in (top, bottom):
        cv2.rectangle(gold, (0, y - height // 80), (width, y + height // 80), 255, -1)
    share = (gold / 255.0)[..., None]
    colors = (share * GOLD + (1.0 - share) * np.where(gold[..., None] > 0, INK, colors)).astype(np.uint8)
    small = (WIDTH, HEIGHT)
    return cv2.resize(colors, small, interpolation=cv2.INTER_AREA), cv2.resize(
        gold / 255.0, small, interpolation=cv2.INTER_AREA
    )


def normals_of(heights: np.ndarray, steepness: float) -> np.ndarray:
    """Return codes of glTF's normal map (y up) of a map of heights, whose last column joins its first."""
    dx = 0.5 * (np.roll(heights, -1, 1) - np.roll(heights, 1, 1))
    dy = np.gradient(heights, axis=0)
    normal = np.stack([-steepness * dx, steepness * dy, np.ones_like(heights)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.round(127.5 + 127.5 * normal).astype(np.uint8)


def make_jar() -> trimesh.Scene:
    """Return the jar in glTF's axes (y up, metres), its foot at the origin."""
    colors, gold = draw_label()
    surface = np.stack([np.zeros_like(gold), 0.42 - 0.2 * gold, gold], axis=-1)
    body = PBRMaterial(
        name="label",
        baseColorTexture=Image.fromarray(colors),
        metallicRoughnessTexture=Image.fromarray(np.round(255.0 * surface[::2, ::2]).astype(np.uint8)),
        normalTexture=Image.fromarray(normals_of(cv2.GaussianBlur(gold, (0, 0), 1.2), 1.5)),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )
    ribs = np.tile(np.cos(2.0 * np.pi * RIBS * (np.arange(768) + 0.5) / 768.0), (64, 1))
    ribs[:36] = 0.0  # the top is plain: v from 0.44 on
    lid = PBRMaterial(
        name="lid",
        baseColorFactor=[0.91, 0.87, 0.8, 1.0],
        metallicFactor=1.0,
        roughnessFactor=0.28,
        normalTexture=Image.fromarray(normals_of(ribs, 0.6)),
    )
    scene = trimesh.Scene()
    for name, outline, material in (("body", BODY, body), ("lid", LID, lid)):
        positions, normals, uvs, faces = turn_outline(outline)
        upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
        mesh = trimesh.Trimesh(positions @ upright, faces, vertex_normals=normals @ upright, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    return scene


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "meshes" / "jar.glb")
    options = parser.parse_args()
    options.out.write_bytes(trimesh.exchange.gltf.export_glb(make_jar(), include_normals=True))


if __name__ == "__main__":
    main()
