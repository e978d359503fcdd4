"""The stages, in the order in which they may run."""

from __future__ import annotations

from warp_ar.stages.accumulate import Accumulate
from warp_ar.stages.base import Stage
from warp_ar.stages.bracket import Bracket
from warp_ar.stages.captured import Captured
from warp_ar.stages.composite import Composite
from warp_ar.stages.declip import Declip
from warp_ar.stages.environment_samples import EnvironmentSamples
from warp_ar.stages.environment_shadow import EnvironmentShadow
from warp_ar.stages.expose import Expose
from warp_ar.stages.fill import Fill
from warp_ar.stages.irradiance import Irradiance
from warp_ar.stages.key_lights import KeyLights
from warp_ar.stages.mirror_ball import MirrorBall
from warp_ar.stages.near_field import NearField
from warp_ar.stages.prefilter import Prefilter
from warp_ar.stages.recover import Recover
from warp_ar.stages.relight import Relight
from warp_ar.stages.shade import Shade
from warp_ar.stages.summed_area import SummedArea
from warp_ar.stages.unwrap import Unwrap
from warp_ar.stages.visibility import Visibility

STAGES: tuple[type[Stage], ...] = (
    Captured,
    Unwrap,
    Bracket,
    Accumulate,
    Fill,
    Recover,
    KeyLights,
    Irradiance,
    Prefilter,
    Visibility,
    SummedArea,
    EnvironmentSamples,
    Relight,
    EnvironmentShadow,
    NearField,
    Shade,
    MirrorBall,
    Composite,
    Declip,
    Expose,
)
