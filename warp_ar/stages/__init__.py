"""The stages, in the order in which they may run."""

from __future__ import annotations

from warp_ar.stages.base import Stage

STAGES: tuple[type[Stage], ...] = ()
