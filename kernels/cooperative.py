"""Sums that threads make together: over a warp's lanes, a block, or a team of blocks.

A warp works on each sum: its lanes take a share each, side by side, and add them up without waiting for other warps. On
CPU a warp is one lane, and a block is one warp.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def lane_count() -> wp.int32:
    """Lanes of a warp."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
#endif
    return value;
""")
def warp_sum(value: wp.vec4) -> wp.vec4:
    """Sum over the warp's lanes, known to all of them, the same in all bits."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int first = (threadIdx.x & 31) / share * share;
    const unsigned int lanes = (share == 32 ? 0xffffffffu : (1u << share) - 1u) << first;
    for (int k = 0; k < 3; ++k) value[k] = __shfl_sync(lanes, value[k], first + lane);
#endif
    return value;
""")
def of_lane(value: wp.vec3, lane: wp.int32, share: wp.int32) -> wp.vec3:
    """What one of ``share`` lanes beside each other has, known to all of them.

    ``share`` is a power of 2, 32 at most, and 1 on CPU.
    """


@wp.func
def sum_beside(value: wp.vec3, share: wp.int32) -> wp.vec3:
    """Sum over ``share`` lanes beside each other in their order, known to all of them; ``share`` as in ``of_lane``."""
    total = wp.vec3(0.0)
    for lane in range(share):
        total += of_lane(value, lane, share)
    return total


# A team is the block, or several blocks of one cluster where the device has them (from compute capability 9.0 on):
# their sums go into each other's shared memory. Where they go is another place every other time, so that a block which
# is ahead does not overwrite what one that is behind still reads.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float parts[32][4], shares[2][16][4];
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
    const int lane = threadIdx.x & 31;
    if (lane == 0)
        for (int k = 0; k < 4; ++k) parts[threadIdx.x / 32][k] = value[k];
    __syncthreads();
    for (int k = 0; k < 4; ++k) value[k] = lane < blockDim.x / 32 ? parts[lane][k] : 0.0f;
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
#if __CUDA_ARCH__ >= 900
    if (blocks > 1) {
        if (threadIdx.x < 4 * blocks) {
            const unsigned int to = threadIdx.x / 4, part = threadIdx.x % 4;
            const unsigned int own = __cvta_generic_to_shared(&shares[turn % 2][blockIdx.x % blocks][part]);
            const float sum = part == 0 ? value[0] : part == 1 ? value[1] : part == 2 ? value[2] : value[3];
            unsigned int other;
            asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(other) : "r"(own), "r"(to));
            asm volatile("st.shared::cluster.f32 [%0], %1;" :: "r"(other), "f"(sum) : "memory");
        }
        asm volatile("barrier.cluster.arrive.release.aligned; barrier.cluster.wait.acquire.aligned;" ::: "memory");
        for (int k = 0; k < 4; ++k) {
            value[k] = 0.0f;
            for (int block = 0; block < blocks; ++block) value[k] += shares[turn % 2][block][k];
        }
        return value;
    }
#endif
    __syncthreads();
#endif
    return value;
""")
def team_sum(value: wp.vec4, blocks: wp.int32, turn: wp.int32) -> wp.vec4:
    """Sum over the team's threads, known to all of them, the same in all bits.

    What was written before can be read after it. ``turn`` counts the calls.
    """


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float parts[32];
    for (int reach = 16; reach > 0; reach /= 2) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, reach));
    const int lane = threadIdx.x & 31;
    if (lane == 0) parts[threadIdx.x / 32] = value;
    __syncthreads();
    value = parts[lane < blockDim.x / 32 ? lane : 0];
    for (int reach = 16; reach > 0; reach /= 2) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, reach));
    __syncthreads();
#endif
    return value;
""")
def block_max(value: wp.float32) -> wp.float32:
    """Largest value of the block's threads, known to all of them."""


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    __shared__ float shares[2][16];
    if (blocks > 1) {
        if (threadIdx.x < blocks) {
            const unsigned int own = __cvta_generic_to_shared(&shares[turn % 2][blockIdx.x % blocks]);
            unsigned int other;
            asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(other) : "r"(own), "r"(threadIdx.x));
            asm volatile("st.shared::cluster.f32 [%0], %1;" :: "r"(other), "f"(value) : "memory");
        }
        asm volatile("barrier.cluster.arrive.release.aligned; barrier.cluster.wait.acquire.aligned;" ::: "memory");
        for (int block = 0; block < blocks; ++block) value = fmaxf(value, shares[turn % 2][block]);
    }
#endif
    return value;
""")
def team_max(value: wp.float32, blocks: wp.int32, turn: wp.int32) -> wp.float32:
    """Largest value of the team's blocks, known to all of them; arguments as ``team_sum``."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float from[3];
    if (threadIdx.x == 0)
        for (int k = 0; k < 3; ++k) from[k] = value[k];
    __syncthreads();
    for (int k = 0; k < 3; ++k) value[k] = from[k];
    __syncthreads();
#endif
    return value;
""")
def from_first(value: wp.vec3) -> wp.vec3:
    """What the block's first thread has, known to all of them."""
