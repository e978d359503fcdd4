"""Values that neighbouring lanes of a CUDA warp share; on CPU a lane stands alone."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int first = (threadIdx.x & 31) / share * share;
    const unsigned int lanes = (share == 32 ? 0xffffffffu : (1u << share) - 1u) << first;
    for (int k = 0; k < 3; ++k) value[k] = __shfl_sync(lanes, value[k], first + lane);
#endif
    return value;
""")
def of_lane(value: wp.vec3, lane: wp.int32, share: wp.int32) -> wp.vec3:
    """Return the value of one of ``share`` lanes beside each other, in all of them.

    ``share`` is a power of 2, 32 at most, and 1 on CPU.
    """


@wp.func
def sum_beside(value: wp.vec3, share: wp.int32) -> wp.vec3:
    """Return the sum over ``share`` lanes beside each other, in their order; ``share`` as in ``of_lane``."""
    total = wp.vec3(0.0)
    for lane in range(share):
        total += of_lane(value, lane, share)
    return total
