"""``python -m warp_ar.farm``."""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.farm.cli")
