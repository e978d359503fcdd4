"""Write the bracket of photographs that the documentation uses: ``python -m tests.make_photographs DIR``.

A rendered room, five exposures of two stops with a sensor's noise, EXIF as a camera writes it. Prints the pixel at
which the ball touches the table.
"""

from __future__ import annotations

import pathlib
import sys

import numpy as np

from tests.photo_files import FOCAL_35MM, encode_srgb, write_photo
from tests.rendered_room import Room, look_at, render

SIZE = (1200, 900)
EXPOSURES = (15, 60, 250, 1000, 4000)
GAIN = 30.0


def main(folder: pathlib.Path) -> None:
    """Render once, expose five times."""
    folder.mkdir(parents=True, exist_ok=True)
    focal = FOCAL_35MM / np.hypot(36, 24) * np.hypot(*SIZE)
    matrix = np.array([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]])
    room = Room(seed=3, table=(0.8, 0.6), reflectance=0.85, lamp=60.0)
    rotation, translation = look_at(room.center + np.array([0.08, -0.62, 0.36]), np.array([0.04, 0.03, 0.03]))
    linear = render(room, matrix, (rotation, translation), SIZE, samples=2)
    random = np.random.default_rng(0)
    for denominator in EXPOSURES:
        light = GAIN / denominator * linear
        light = light + random.normal(size=light.shape) * np.sqrt(1e-6 + 4e-4 * np.clip(light, 0, 1))
        write_photo(folder / f"ball_{denominator}.jpg", encode_srgb(light), denominator=denominator)
    x, y, z = translation
    print(f"--contact {x / z * focal + matrix[0, 2]:.1f} {y / z * focal + matrix[1, 2]:.1f}")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
