"""Stage ``irradiance``: irradiance from the environment for every surface normal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import irradiance, sphere_map
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features

MAP_SIZE = (32, 64)  # bilinear error of a cosine lobe: (pi / 32)^2 / 8 = 0.12 % of its peak
CLUSTERS = (10, 20)


class Irradiance(Stage):
    """Filters the environment with the cosine lobe."""

    name: ClassVar[str] = "irradiance"
    methods: ClassVar[Mapping[str, str]] = {
        "sphere_mip": "a 4x4 level of the sphere map with background",
        "sh2": "spherical harmonics of order 2",
        "clusters": "200 clusters of the environment for every direction",
        "brute_force": "every texel for every direction",
    }
    summary: ClassVar[str] = "irradiance of the environment for every orientation"
    subject: ClassVar[str] = "light that matt surfaces receive"
    unread: ClassVar[str] = "no virtual object is diffuse, and relighting does not ask for the receiver's reflectance"
    converges: ClassVar[bool] = True
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    unseen_method: ClassVar[str | None] = "sh2"
    numerics: ClassVar[Numerics] = Numerics(
        "float32 sums of sums over tables made in float64", 1e-3, "a texel's spread by its second moment; sums 1e-6"
    )

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Return the quality's method, but spherical harmonics instead of the paper's if the light is from a file."""
        method = super().method_for(features)
        return "sh2" if method == "sphere_mip" and not features.observed else method

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written: the environment, and irradiance in the method's form."""
        if not features.environment:
            return LeftOut(NO_BALL)
        by_texture = cls.method_for(features) == "sphere_mip"
        reads = ("sphere_map", "pose") if by_texture else ("environment",)
        if features.others_with_irradiance:
            return Wiring((*reads, "others_environment"), (features.irradiance, "others_irradiance"))
        return Wiring(reads, (features.irradiance,))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of irradiance and its partial sums."""
        specs, others = self._first(), self.features.others_with_irradiance
        if others:
            form = specs[self.features.irradiance]
            specs["others_irradiance"] = ArraySpec((others, *form.shape), form.dtype)
        return specs

    def _first(self) -> dict[str, ArraySpec]:
        if self.method == "sphere_mip":
            return {"irradiance_map": ArraySpec(MAP_SIZE, wp.vec3)}
        if self.method == "sh2":
            return {
                "irradiance_sh": ArraySpec((9,), wp.vec3),
                "irradiance_row_sums": ArraySpec((self.map_height, 5), wp.vec3),
            }
        count = math.prod(self._blocks())
        return {
            "irradiance_map": ArraySpec(MAP_SIZE, wp.vec3),
            "irradiance_clusters": ArraySpec((count,), irradiance.Cluster, irradiance.Cluster()),
        }

    def _blocks(self) -> tuple[int, int]:
        rows, columns = self.map_shape
        if self.method == "brute_force":
            return rows, columns
        return min(CLUSTERS[0], rows), min(CLUSTERS[1], columns)

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return the launches of the method, with the tables that they need."""
        if self.method == "sphere_mip":
            level = int(math.log2(sphere_map.SIZE // sphere_map.DIFFUSE_SIZE))
            known, out = (arrays["params"], arrays["sphere_map"], level, MAP_SIZE), arrays["irradiance_map"].flatten()
            return [over_rows(MAP_SIZE[0], sphere_map.look_up_level, *known, out, scale=math.pi)]
        passes = self._filter(arrays, arrays["environment"], arrays[self.features.irradiance])
        for ball in range(self.features.others_with_irradiance):
            passes += self._filter(arrays, arrays["others_environment"][ball], arrays["others_irradiance"][ball])
        return passes

    def _filter(self, arrays: Arrays, environment: Any, target: Any) -> list[Pass]:
        """Return the passes from one map of the environment to its irradiance; maps share the sums in turn."""
        if self.method == "sh2":
            tables = irradiance.make_sh_tables(*environment.shape, environment.device)
            sums = arrays["irradiance_row_sums"]
            return [
                Pass(lambda rows: irradiance.project_irradiance_sh(environment, tables, sums, target)),
                Pass(lambda rows: irradiance.window_sh(target)),
            ]
        blocks = self._blocks()
        clusters = arrays["irradiance_clusters"]
        return [
            over_rows(blocks[0], irradiance.gather_clusters, environment, blocks, clusters),
            over_rows(MAP_SIZE[0], irradiance.sum_clusters, clusters, target),
        ]
