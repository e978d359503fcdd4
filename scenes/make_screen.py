"""Draw the picture on the screen of the scene ``screen``.

    python scenes/make_screen.py [--out scenes/meshes/screen.png]

An orange sun over a blue sea: two colours of light that differ clearly on the desk before the screen. The picture is
drawn four times as large and averaged.
"""

from __future__ import annotations

import argparse
import pathlib

import cv2
import numpy as np

WIDTH, HEIGHT, FINE = 96, 60, 4
HERE = pathlib.Path(__file__).resolve().parent


def draw_screen() -> np.ndarray:
    """Return the picture, (60, 96, 3) BGR, sRGB-encoded."""
    y, x = np.mgrid[: HEIGHT * FINE, : WIDTH * FINE] + 0.5
    x, y = x / (WIDTH * FINE), y / (WIDTH * FINE)
    sky = np.stack([255.0 - 60.0 * x, 120.0 - 80.0 * x, 20.0 + 20.0 * x], axis=-1)
    away = np.hypot(x - 0.72, y - 0.3)[..., None]
    sun = np.array([20.0, 140.0, 255.0])
    image = np.where(away < 0.2, sun, sky)
    image[(y > 0.5) & (np.floor(40.0 * y) % 2 == 0)] *= 0.35  # the sea
    edge = (x < 0.02) | (x > 0.98) | (y < 0.02) | (y > HEIGHT / WIDTH - 0.02)
    image[edge] = 3.0
    return cv2.resize(image.astype(np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "meshes" / "screen.png")
    options = parser.parse_args()
    if not cv2.imwrite(str(options.out), draw_screen(), [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise SystemExit(f"{options.out} cannot be written")


if __name__ == "__main__":
    main()
