"""Radiance's HDR: other readers see what was written, within half a step."""

from __future__ import annotations

import pathlib

import cv2
import numpy as np
import pytest

from warp_ar.output.radiance_hdr import encode_hdr
from warp_ar.signature import is_signed

STEP = 1.0 / 256.0  # half of the least mantissa, 1 part in 128


def written(tmp_path: pathlib.Path, radiance: np.ndarray) -> pathlib.Path:
    path = tmp_path / "e.hdr"
    path.write_bytes(encode_hdr(radiance, "latlong"))
    return path


def read(path: pathlib.Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


def test_opencv_reads_it_within_half_a_step(tmp_path: pathlib.Path) -> None:
    rng = np.random.default_rng(0)
    radiance = np.exp(rng.uniform(-20, 20, (64, 128, 3))).astype(np.float32)
    error = np.abs(read(written(tmp_path, radiance)) - radiance) / radiance.max(2, keepdims=True)
    assert error.max() <= STEP
    assert is_signed(tmp_path / "e.hdr")


def test_edges_of_its_range(tmp_path: pathlib.Path) -> None:
    """255.6 steps round to the next exponent; black, no number, negative and endless values are told."""
    values = [0.0, 0.999, 1.0, 255.6 / 256, np.nan, -1.0, np.inf, 1e-44]
    radiance = np.repeat(np.array(values, np.float32)[None, :, None], 3, 2)
    back = read(written(tmp_path, radiance))[0, :, 0]
    np.testing.assert_allclose(back[:4], values[:4], rtol=STEP)
    assert back[4] == back[5] == back[7] == 0.0
    assert back[6] == pytest.approx(1e38, rel=STEP)


def test_a_wide_map_is_not_taken_for_run_lengths(tmp_path: pathlib.Path) -> None:
    """A scanline that began with 2, 2 would be: the brightest mantissa, at 128 or more, forbids it."""
    radiance = np.full((2, 300, 3), 2.0 / 256, np.float32)
    radiance[..., 2] = 300 / 65536
    back = read(written(tmp_path, radiance))
    assert np.abs(back - radiance).max() <= STEP * radiance.max()
