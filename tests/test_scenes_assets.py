"""The bundled scenes are whole: every file that they name exists, and every clip opens and shows the marker."""

from __future__ import annotations

import pathlib
import tomllib

import av
import cv2
import numpy as np
import pytest
import trimesh

SCENES = pathlib.Path(__file__).resolve().parents[1] / "scenes"
NAMES = ("darken", "desk", "mirror", "product", "screen", "torus", "wire_coincident", "wire_opposing")
CLIP_BYTES = 2_500_000
"""Largest clip that may be committed."""
NORMAL_TOLERANCE = 1e-5
"""Unit length of a float32 normal, stored rounded."""


def load(name: str) -> dict:
    return tomllib.loads((SCENES / f"{name}.toml").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_the_ball_stands_on_the_table_proxy(name: str) -> None:
    scene = load(name)
    ball = scene["probe"]
    for plane in (proxy for proxy in scene.get("proxy", []) if proxy["shape"] == "plane"):
        assert ball["center"][2] - ball["radius"] == pytest.approx(plane["at"][2], abs=1e-9)


@pytest.mark.parametrize("clip", sorted({load(name)["source"]["path"] for name in NAMES}))
def test_clip_opens_and_shows_the_marker(clip: str) -> None:
    scene = next(load(name) for name in NAMES if load(name)["source"]["path"] == clip)
    path = SCENES / clip
    assert path.stat().st_size < CLIP_BYTES
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (scene["camera"]["width"], scene["camera"]["height"])
        assert float(stream.average_rate) == scene["source"]["fps"]
        first = next(container.decode(stream)).to_ndarray(format="gray")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, scene["marker"]["dictionary"]))
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(first)
    assert ids is not None
    assert ids.ravel().tolist() == [scene["marker"]["id"]]


def test_the_default_clip_is_long_enough_and_its_light_changes() -> None:
    with av.open(str(SCENES / load("desk")["source"]["path"])) as container:
        means = [frame.to_ndarray(format="rgb24")[::8, ::8].mean((0, 1)) for frame in container.decode(video=0)]
    means = np.array(means)
    assert len(means) >= 96
    assert means[:, 2].max() > 1.3 * means[:, 2].min()  # daylight goes
    warmth = means[:, 0] / means[:, 2]
    assert warmth.max() > 1.15 * warmth.min()  # and lamplight comes


def test_teapot_normals_are_unit_and_face_outward() -> None:
    mesh = trimesh.load(SCENES / "meshes" / "teapot.ply", process=False)
    assert 3000 <= len(mesh.faces) <= 6000
    assert np.allclose(np.linalg.norm(mesh.vertex_normals, axis=-1), 1.0, atol=NORMAL_TOLERANCE)
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.vertex_normals[mesh.faces].mean(1)) > 0.0).all()
    assert mesh.bounds[0, 2] == 0.0  # it stands on z = 0
    assert mesh.face_normals[mesh.triangles_center[:, 2] > 3.1, 2].min() > 0.0  # the setting's top looks up
