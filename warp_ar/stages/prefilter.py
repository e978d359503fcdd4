"""Stage ``prefilter``: the environment filtered for glossy materials, from mirror to matt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_ar.kernels.environment import lobes, prefilter, pyramid, sphere_map
from warp_ar.scene import Material, MirrorMaterial, PhongMaterial, Scene
from warp_ar.scene.object_materials import reflects_glossily, scene_materials
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features


def glossy_materials(scene: Scene) -> list[Material]:
    """Return the materials of virtual objects with more than diffuse reflection."""
    return [material.surface for material in scene_materials(scene) if reflects_glossily(material)]


def scene_lobe(scene: Scene) -> lobes.Lobe:
    """Return the lobe for all glossy materials: Phong if all are Phong, else GGX of the nearest widths."""
    kinds = {type(material) for material in glossy_materials(scene)} - {MirrorMaterial}
    return "phong" if kinds == {PhongMaterial} else "ggx"


class Prefilter(Stage):
    """Prefilters the environment with lobes of growing width."""

    name: ClassVar[str] = "prefilter"
    methods: ClassVar[Mapping[str, str]] = {
        "sphere_mip": "mip levels of the sphere map with background",
        "energy_mip": "an energy-conserving pyramid, mixed to fit the lobe",
        "fis128": "128 importance samples per texel",
        "brute_force": "every texel for every direction and width",
    }
    summary: ClassVar[str] = "the environment filtered for glossy reflection, level by level"
    subject: ClassVar[str] = "light that glossy surfaces reflect"
    unread: ClassVar[str] = "no virtual object has a glossy material"
    converges: ClassVar[bool] = True
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    unseen_method: ClassVar[str | None] = "energy_mip"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; versines, weights made in float64", 5e-5, "sums over the map, powers with exponents up to 1e3"
    )

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Return the quality's method, but ``energy_mip`` instead of the paper's for light from a file."""
        method = super().method_for(features)
        return "energy_mip" if method == "sphere_mip" and not features.observed else method

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written: the environment, and its filtered levels."""
        if not features.environment:
            return LeftOut(NO_BALL)
        by_texture = cls.method_for(features) == "sphere_mip"
        reads = ("sphere_map", "pose") if by_texture else ("environment",)
        if cls._others(features):
            return Wiring((*reads, "others_environment"), ("prefilter_levels", "others_levels"))
        return Wiring(reads, ("prefilter_levels",))

    @staticmethod
    def _others(features: Features) -> int:
        return features.others if features.distant.specular else 0

    @property
    def _mirrors_only(self) -> bool:
        scene = self.request.scene
        mirrors = all(isinstance(material, MirrorMaterial) for material in glossy_materials(scene))
        mirrors &= not scene.has_gloss
        # Light that objects reflect onto the receiver uses a wide lobe for every material.
        return mirrors and not self.features.shadowed

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the levels, and the pyramid from which they are filtered."""
        height = self.map_height
        specs = {"prefilter_levels": ArraySpec((lobes.lobe_texels(height),), wp.vec3)}
        if others := self._others(self.features):
            specs["others_levels"] = ArraySpec((others, lobes.lobe_texels(height)), wp.vec3)
        if self.method == "sphere_mip":
            return specs
        if self.method != "brute_force" and not self._mirrors_only:
            specs["prefilter_pyramid"] = ArraySpec((pyramid.packed_texels(*self.map_shape),), wp.vec3)
            specs["prefilter_row_energy"] = ArraySpec((lobes.lobe_rows(height),), wp.vec3)
            specs["prefilter_energy"] = ArraySpec((lobes.lobe_count(height),), wp.vec3)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return the launches of the method; weights and samples are computed here, once."""
        if self.method == "sphere_mip":
            return self._look_up(arrays)
        passes = self._filter(arrays, arrays["environment"], arrays["prefilter_levels"])
        for ball in range(self._others(self.features)):
            passes += self._filter(arrays, arrays["others_environment"][ball], arrays["others_levels"][ball])
        return passes

    def _filter(self, arrays: Arrays, environment: Any, levels: Any) -> list[Pass]:
        """Return the passes from one map of the environment to its levels; all maps reuse one pyramid."""
        height, device = self.map_height, environment.device
        lobe = scene_lobe(self.request.scene)
        if self._mirrors_only:
            return [over_rows(height, pyramid.copy_safe, environment, levels)]
        texels = levels.shape[0]
        if self.method == "brute_force":
            return [over_rows(texels, prefilter.integrate_lobes, environment, lobe == "phong", levels)]

        mips = arrays["prefilter_pyramid"]
        passes = [Pass(lambda rows: pyramid.build_pyramid(environment, mips))]
        if self.method == "energy_mip":
            weights = wp.array(lobes.mip_weights(height, lobe).astype(np.float32), dtype=wp.float32, device=device)
            passes.append(over_rows(texels, prefilter.mix_mips, mips, weights, height, levels))
        else:
            drawn = lobes.make_lobe_samples(height, lobe, int(self.method.removeprefix("fis")), device)
            samples = drawn.directions, drawn.weights
            passes.append(over_rows(texels, prefilter.sample_lobes, mips, *samples, height, levels))
        row_energy, energy = arrays["prefilter_row_energy"], arrays["prefilter_energy"]
        return [
            *passes,
            Pass(lambda rows: prefilter.measure_energy(levels, height, row_energy, energy)),
            over_rows(texels, prefilter.scale_levels, energy, height, levels),
        ]

    def _look_up(self, arrays: Arrays) -> list[Pass]:
        """Return one pass per lobe, which writes its map from a sphere map level; mirrors need the first lobe alone."""
        height = self.map_height
        count = lobes.lobe_count(height)
        known, out = (arrays["params"], arrays["sphere_map"]), arrays["prefilter_levels"]
        passes = []
        for lobe in range(1 if self._mirrors_only else count):
            size = lobes.lobe_size(height, lobe)
            place, first = (sphere_map.glossy_level(lobe, count), size, out), lobes.lobe_offset(height, lobe)
            passes.append(over_rows(size[0], sphere_map.look_up_level, *known, *place, first=first))
        return passes
