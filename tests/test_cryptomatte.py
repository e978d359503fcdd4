"""Mattes: hashes by published vectors, and what a compositor picks by a name."""

import json

import numpy as np
import pytest

from warp_ar.output.cryptomatte import LAYER, matte_bits, matte_channels, matte_header, murmur3


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", 0),
        ("a", 0x3C2569B2),
        ("ab", 0x9BBFD75F),
        ("abc", 0xB3DD93FA),
        ("hello", 0x248BFA47),
        ("hello, world", 0x149BBB7F),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
    ],
)
def test_hash_by_published_vectors(text, value):
    assert murmur3(text.encode()) == value


def test_no_hash_is_a_float_that_cannot_be_kept():
    bits = np.array([matte_bits(f"object_{k}") for k in range(20_000)], np.uint32)
    raw = np.array([murmur3(f"object_{k}".encode()) for k in range(20_000)], np.uint32)
    changed = bits != raw
    assert changed.any(), "some fall on denormal, infinite or NaN floats"
    assert np.isfinite(bits.view(np.float32)).all()
    assert (np.abs(bits.view(np.float32)) >= np.finfo(np.float32).tiny).all()


def test_a_name_picks_its_matte():
    names = ("sphere", "plane", "ball")
    coverage = np.zeros((2, 2, 8), np.float32)
    coverage[..., 0::2] = -1.0
    coverage[0, 0, :4] = (1, 0.75, 0, 0.25)
    coverage[1, 1, :6] = (2, 0.5, 1, 0.25, 0, 0.25)
    channels = matte_channels(coverage, names)
    assert sorted(channels) == [f"{LAYER}{rank}.{c}" for rank in ("00", "01") for c in "ABGR"]
    header = matte_header(names)
    key = next(iter(header)).rsplit("/", 1)[0]
    assert len(key) == len("cryptomatte/") + 7
    manifest = json.loads(header[f"{key}/manifest"])
    for number, name in enumerate(names):
        wanted = np.array([int(manifest[name], 16)], np.uint32).view(np.float32)[0]
        matte = sum(
            np.where(channels[f"{LAYER}{rank}.{a}"] == wanted, channels[f"{LAYER}{rank}.{b}"], 0.0)
            for rank in ("00", "01")
            for a, b in ("RG", "BA")
        )
        expected = sum(np.where(coverage[..., 2 * k] == number, coverage[..., 2 * k + 1], 0.0) for k in range(4))
        np.testing.assert_array_equal(matte, expected)
