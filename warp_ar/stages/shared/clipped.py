"""What tells the radiance of clipped pixels, for the picture at another exposure and for its plate alone."""

from __future__ import annotations

from warp_ar.kernels.picture.expose import ClippedEvidence, make_clipped_evidence
from warp_ar.stages.base import Arrays, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.request import Request

SUMMED = "summed_area"
"""Resource: the frame's summed-area table."""
SUMMED_CUT = "summed_area_cut"
"""Resource: that of what 8 bits cut off, for frames of more."""


def box_reads(features: Features) -> tuple[str, ...]:
    """Tables of what surrounds clipped pixels, where the method of ``expose`` looks at that."""
    if not features.boxed:
        return ()
    return (SUMMED, SUMMED_CUT) if features.request.linear else (SUMMED,)


def clipped_evidence(request: Request, wiring: Wiring, arrays: Arrays) -> ClippedEvidence:
    """All of it that a stage with this wiring reads."""
    known = [arrays[name] if name in wiring.reads else None for name in (SUMMED, "declipped", SUMMED_CUT)]
    return make_clipped_evidence(request.size[1], *known, levels=arrays["linear_clip"] if request.linear else None)
