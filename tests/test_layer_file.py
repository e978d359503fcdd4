"""Layers as files: what a compositor reads is what the pipeline gave."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.layer_rig import POSES, SIZE, make_frame, make_scene, run
from tests.twins import color as reference_color
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SinkError
from warp_ar.output.layer_file import (
    DEPTH_STEP,
    PICTURES,
    LayerFrame,
    LayerSink,
    SideFiles,
    compose_layers,
    layer_frame,
    write_layers,
)
from warp_ar.scene import Exposure
from warp_ar.stages.request import LAYERS, PICTURE_LAYERS

pytestmark = pytest.mark.slow

# 16-bit floats have a step of 2^-11 of their value: at white an eighth of a code, and the picture sums five of them.
HALF_CODES = 1.0
HALF = 2.0**-11


@pytest.fixture(scope="module")
def rendered():
    """Scene, frame and result, with every layer."""
    scene = make_scene(exposure=Exposure(0.7))
    with Pipeline(scene, device="cpu", quality="low", outputs=("image", *LAYERS)) as pipeline:
        return scene, make_frame(1), run(pipeline)[1]


def parts_of(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {
            part.header["name"]: (dict(part.header), {name: channel.pixels for name, channel in part.channels.items()})
            for part in file.parts
        }


@pytest.fixture(scope="module")
def written(rendered, tmp_path_factory):
    scene, frame, result = rendered
    path = tmp_path_factory.mktemp("layers") / "0000.exr"
    write_layers(path, layer_frame(frame, result, scene))
    return parts_of(path)


def stacked(written, name, channels):
    _, found = written[name]
    return np.stack([found[f"{name}.{c}"] for c in channels], -1).astype(np.float32)


def test_a_file_recombines_to_the_picture(rendered, written):
    _, _, result = rendered
    layers = {name: stacked(written, name, "RGBA" if name == "objects" else "RGB") for name in PICTURE_LAYERS}
    scale = written["picture"][0]["exposureScale"]
    assert scale == pytest.approx(0.7)
    linear = compose_layers(layers)
    codes = reference_color.encoded_srgb(np.clip(scale * linear, 0.0, 1.0))
    assert np.abs(codes - result.image).max() <= HALF_CODES
    picture = np.stack([written["picture"][1][c] for c in "RGB"], -1).astype(np.float32)
    np.testing.assert_allclose(picture, compose_layers(result.layers), rtol=HALF, atol=1e-6)


def test_values_are_those_of_the_result(rendered, written):
    _, _, result = rendered
    np.testing.assert_array_equal(written["depth"][1]["Z"], result.layers["depth"])
    np.testing.assert_array_equal(stacked(written, "position", "XYZ"), result.layers["position"])
    np.testing.assert_array_equal(stacked(written, "normals", "XYZ"), result.layers["normals"])
    np.testing.assert_array_equal(stacked(written, "motion", "XY"), result.layers["motion"])
    np.testing.assert_array_equal(written["ids"][1]["ids.I"], result.layers["ids"] + 1)


def test_the_header_places_the_camera(rendered, written):
    """A pixel's place, by the file alone, is where its depth says."""
    scene, _, _ = rendered
    header, _ = written["position"]
    np.testing.assert_allclose(header["cameraFromWorld"][:3, :3], POSES[1].rotation, atol=1e-6)
    np.testing.assert_allclose(header["cameraFromWorld"][:3, 3], POSES[1].translation, atol=1e-6)
    np.testing.assert_allclose(header["cameraMatrix"], scene.camera.matrix(), rtol=1e-6)
    places = stacked(written, "position", "XYZ").reshape(-1, 3)
    depth = written["depth"][1]["Z"].ravel()
    known = np.isfinite(depth)
    in_camera = places @ header["cameraFromWorld"][:3, :3].T + header["cameraFromWorld"][:3, 3]
    np.testing.assert_allclose(in_camera[known, 2], depth[known], rtol=1e-5)
    # OpenEXR's own attribute: rows are mapped, the camera looks along -z, y is up.
    of_compositors = np.concatenate([places, np.ones((len(places), 1))], 1) @ header["worldToCamera"]
    np.testing.assert_allclose(of_compositors[known, :3], in_camera[known] * (1, -1, -1), atol=1e-5)


def test_openimageio_reads_every_part(rendered, written, tmp_path):
    """Names, types, windows and numbers as compositors see them."""
    oiio = pytest.importorskip("OpenImageIO")
    scene, frame, result = rendered
    write_layers(tmp_path / "a.exr", layer_frame(frame, result, scene))
    opened = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    parts = {}
    while opened.seek_subimage(len(parts), 0):
        spec = opened.spec()
        assert (spec.x, spec.y, spec.full_x, spec.full_y) == (0, 0, 0, 0)
        assert (spec.width, spec.height) == (spec.full_width, spec.full_height) == frame.shape[1::-1]
        wide = spec.getattribute("name") in ("ids", "coverage", "depth", "normals", "position", "motion")
        assert str(spec.format) == ("uint" if spec.getattribute("name") == "ids" else "float" if wide else "half")
        assert spec.getattribute("worldToCamera") is not None
        number = len(parts)
        parts[spec.getattribute("name")] = (
            list(spec.channelnames),
            np.asarray(opened.read_image(number, 0, 0, spec.nchannels, "float")),
        )
    opened.close()
    assert list(parts) == list(written)
    assert parts["picture"][0] == ["R", "G", "B"]
    assert parts["objects"][0] == [f"objects.{c}" for c in "RGBA"]
    assert parts["depth"][0] == ["Z"]
    picture = np.stack([written["picture"][1][c] for c in "RGB"], -1)
    np.testing.assert_array_equal(parts["picture"][1], picture.astype(np.float32))


def test_mattes_are_named(rendered, written):
    header, channels = written["coverage"]
    manifest = json.loads(next(text for key, text in header.items() if key.endswith("/manifest")))
    assert list(manifest) == [
        "object_0_sphere",
        "object_1_box",
        "object_2_sphere",
        "proxy_0_plane",
        "proxy_1_box",
        "ball_0",
    ]
    ball = np.array([int(manifest["ball_0"], 16)], np.uint32).view(np.float32)[0]
    first = channels["CryptoObject00.R"] == ball
    assert first.any()
    assert (first == (rendered[2].layers["coverage"][..., 0] == 5)).all()


def test_pictures_hold_what_png_can(rendered, tmp_path):
    scene, frame, result = rendered
    with LayerSink(tmp_path / "out", pictures=PICTURES) as sink:
        sink.write(layer_frame(frame, result, scene))

    def read(name):
        return cv2.imread(str(tmp_path / "out" / name / "0000.png"), cv2.IMREAD_UNCHANGED)

    np.testing.assert_array_equal(read("plate")[..., ::-1], frame)
    np.testing.assert_array_equal(read("ids"), result.layers["ids"] + 1)
    depth = read("depth") * DEPTH_STEP
    known = np.isfinite(result.layers["depth"])
    assert known.any()
    np.testing.assert_allclose(depth[known], result.layers["depth"][known], atol=0.5 * DEPTH_STEP + 1e-7)
    assert not depth[~known].any()
    normals = read("normals")[..., ::-1] / 32767.5 - 1.0
    np.testing.assert_allclose(normals, result.layers["normals"], atol=2e-5)


def test_a_depth_that_png_cannot_hold_is_none(rendered, tmp_path):
    scene, frame, result = rendered
    far = dict(result.layers) | {"depth": np.full(SIZE[::-1], 7.0, np.float32)}
    with LayerSink(tmp_path, pictures=("depth",)) as sink:
        sink.write(dataclasses.replace(layer_frame(frame, result, scene), layers=far))
    assert not cv2.imread(str(tmp_path / "depth" / "0000.png"), cv2.IMREAD_UNCHANGED).any()


def test_radiance_beyond_half_is_its_largest(rendered, tmp_path):
    scene, frame, result = rendered
    bright = {"added_light": np.full((SIZE[1], SIZE[0], 3), 1e6, np.float32)}
    write_layers(tmp_path / "a.exr", dataclasses.replace(layer_frame(frame, result, scene), layers=bright))
    assert (parts_of(tmp_path / "a.exr")["added_light"][1]["added_light.R"] == 65504.0).all()


def test_frames_of_others_are_not_replaced(rendered, tmp_path):
    (tmp_path / "0000.exr").write_bytes(b"somebody's")
    with pytest.raises(SinkError, match=r"holds 1 numbered frames that this program did not write"):
        LayerSink(tmp_path)
    (tmp_path / "0000.exr").unlink()
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "0007.png").write_bytes(b"somebody's")
    with pytest.raises(SinkError, match=r"depth holds 1 numbered frames"):
        LayerSink(tmp_path, pictures=("depth",))


def test_what_cannot_be_written_is_said(rendered, tmp_path):
    scene, frame, result = rendered
    sink = LayerSink(tmp_path / "out")
    (tmp_path / "out").rmdir()
    sink.write(layer_frame(frame, result, scene))
    with pytest.raises(SinkError, match=r"0000\.exr cannot be written"):
        sink.close()
    with LayerSink(tmp_path / "other") as other, pytest.raises(SinkError, match="LayerFrame, not ndarray"):
        other.write(frame)
    assert isinstance(layer_frame(frame, result, scene), LayerFrame)


def test_side_files_ask_for_what_they_write(tmp_path):
    with SideFiles() as nothing:
        assert nothing.outputs == ()
        assert nothing.written == ""
    with SideFiles(environment=tmp_path / "e", layers=tmp_path / "l", names=("depth",)) as side:
        assert side.outputs == ("environment", "depth")
        assert side.written == ", and 0 environments, and layers of 0"
