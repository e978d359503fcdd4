"""What ``find_key_lights`` asks of the sectors of the environment: in native code.

Few instructions do it: a warp that has a processor to itself waits for each. ``sectors`` holds, for each sector, its
excess times direction and its length, then the same of what the lights found so far have left over.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

SECTOR_ROWS = wp.constant(8)
SECTOR_COLUMNS = wp.constant(16)
KEY_SECTORS = wp.constant(SECTOR_ROWS * SECTOR_COLUMNS)

_LANES = f"""
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 32;
    const int lane = threadIdx.x & 31;
#else
    constexpr int LANES = 1;
    const int lane = 0;
#endif
    constexpr int SECTORS = {SECTOR_ROWS * SECTOR_COLUMNS}, OWN = SECTORS / LANES;
"""


@wp.func_native(
    _LANES
    + """
    const wp::vec_t<4, float>* left_over = sectors.data + SECTORS;
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[SECTORS];
    for (int sector = threadIdx.x; sector < SECTORS; sector += blockDim.x)
        staged[sector] = make_float4(left_over[sector][0], left_over[sector][1], left_over[sector][2], 0.0f);
    __syncthreads();
    return reinterpret_cast<wp::uint64>(staged);
#else
    return reinterpret_cast<wp::uint64>(left_over);
#endif
"""
)
def stage_sectors(sectors: wp.array[wp.vec4]) -> wp.uint64:
    """Where what is left over can be read fast; for a whole block."""


@wp.func_native(
    _LANES
    + """
    const float* moments = reinterpret_cast<const float*>(staged);
    float sum = 0.0f;
#if defined(__CUDA_ARCH__)
#pragma unroll 8
#endif
    for (int sector = 0; sector < SECTORS; ++sector) {
        const float* at = moments + 4 * sector;
        const float facing = at[0] * toward[0] + at[1] * toward[1] + at[2] * toward[2];
        sum += facing > 0.0f ? facing : 0.0f;
    }
    return sum;
"""
)
def received_from(staged: wp.uint64, toward: wp.vec3) -> wp.float32:
    """What a surface that faces ``toward`` receives of the excess left over; ``staged`` is of ``stage_sectors``."""


@wp.func_native(
    _LANES
    + """
    wp::vec_t<4, float> own[OWN];
    float inverse[OWN];
    for (int n = 0; n < OWN; ++n) {
        own[n] = sectors.data[SECTORS + lane + LANES * n];
        inverse[n] = own[n][3] > 0.0f ? 1.0f / own[n][3] : 0.0f;
    }
#if defined(__CUDA_ARCH__)
#pragma unroll 1
#endif
    for (int shift = 0; shift < 10; ++shift) {
        float centre[3] = {0.0f, 0.0f, 0.0f};
        for (int n = 0; n < OWN; ++n) {
            const float facing = own[n][0] * direction[0] + own[n][1] * direction[1] + own[n][2] * direction[2];
            const float cosine = facing * inverse[n], square = cosine * cosine, fourth = square * square;
            const float weight = facing > 0.0f ? (shift < 2 ? 1.0f : shift < 4 ? square : fourth * fourth) : 0.0f;
            for (int k = 0; k < 3; ++k) centre[k] += weight * own[n][k];
        }
#if defined(__CUDA_ARCH__)
        for (int reach = 16; reach > 0; reach /= 2)
            for (int k = 0; k < 3; ++k) centre[k] += __shfl_xor_sync(0xffffffffu, centre[k], reach);
#endif
        const float length = sqrtf(centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]);
        if (length > 0.0f)
            for (int k = 0; k < 3; ++k) direction[k] = centre[k] / length;
    }
    return direction;
"""
)
def shift_on_sectors(sectors: wp.array[wp.vec4], direction: wp.vec3) -> wp.vec3:
    """Ten mean shifts: two with all that faces the direction, two with cos^2, six with cos^8; for a whole warp."""


@wp.func_native(
    _LANES
    + """
    float sum = 0.0f;
    for (int n = 0; n < OWN; ++n) {
        const wp::vec_t<4, float> moment = sectors.data[lane + LANES * n];
        const float facing = moment[0] * direction[0] + moment[1] * direction[1] + moment[2] * direction[2];
        if (facing > 0.0f) {
            const float cosine = facing / moment[3], square = cosine * cosine, fourth = square * square;
            sum += moment[3] * fourth * fourth * fourth * fourth;
        }
    }
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, reach);
#endif
    return sum;
"""
)
def excess_around(sectors: wp.array[wp.vec4], direction: wp.vec3) -> wp.float32:
    """Excess within some 17 degrees of a direction, weighted by cos^16; for a whole warp."""
