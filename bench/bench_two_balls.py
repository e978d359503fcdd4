"""Light that clips in two mirror balls far apart: what matt spheres between them receive, against a rendered truth.

    python -m bench two_balls            # three lamps, medium; some minutes on two cores
    python -m bench two_balls --quality high

A desk with a printed card between two balls, under a lamp 25 times as bright as the camera shows. One JSON line a
lamp: root mean square error of each sphere, from the first ball's side to the second's, over its radiance.

``captured``: as the camera clipped it. ``one``: recovered with the first ball alone. ``both``: recovered with both.
``told``: what the balls would tell without clipping, interpolated, in closed form.
"""

from __future__ import annotations

import argparse
import dataclasses
import json

import numpy as np

from bench.common import commit
from tests.rendered_lamp import Desk
from tests.two_balls import BALLS, PLACES, TwoBalls
from warp_ar.stages.quality import PRESETS

STRONG = Desk(
    lamp_radius=0.02,
    lamp=27.5,
    card=0.08,
    balls=tuple((ball.center, ball.radius, ball.reflectance[0]) for ball in BALLS),
)
LAMPS = {
    "above the first": STRONG,
    "between": dataclasses.replace(STRONG, lamp_at=(0.0, -0.15, 0.4), lamp_radius=0.025),
    "far": dataclasses.replace(STRONG, lamp_at=(-0.6, -1.0, 1.6), lamp_radius=0.1),
}


def main(device: str, arguments: list[str] | None = None) -> None:
    """Print a line a lamp."""
    parser = argparse.ArgumentParser(prog="python -m bench two_balls")
    parser.add_argument("--quality", default="medium")
    quality = PRESETS[parser.parse_args(arguments or []).quality]
    for name, desk in LAMPS.items():
        world = TwoBalls(desk, detail=2)
        clipped = quality.with_methods(recover="clipped")
        cases = {"captured": (BALLS, clipped), "one": (BALLS[:1], quality), "both": (BALLS, quality)}
        rows = {case: world.errors(world.lit(probes, chosen, device)) for case, (probes, chosen) in cases.items()}
        rows["told"] = world.errors([world.foreseen(BALLS, index)[0] for index in range(len(PLACES))])
        told = {case: np.round(row, 3).tolist() for case, row in rows.items()}
        print(json.dumps({"bench": "two_balls", "lamp": name, "quality": quality.name, **told, "commit": commit()}))
