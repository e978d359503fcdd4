"""A warp's part of a row of 8-bit pixels: how a frame is read once, and a picture written once, in whole words.

A pixel's three bytes by themselves are three loads and three stores of a byte each, and memory writes 32 bytes at a
time. So a warp takes ``WARP_PIXELS`` neighbours of a row, loads their words side by side into its own part of the
block's shared memory, works on them there, pixel k of a round to lane k, so that what else is read of a pixel is read
side by side too, and stores the words side by side. CUDA only, and only where rows begin at words; elsewhere a thread
takes ``row_parts``' run of neighbours, pixel after pixel.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

WARP_PIXELS = wp.constant(128)
"""Pixels of a row that a warp takes."""
WARP_LANES = wp.constant(32)

CPU_RUN = 32
"""Pixels of a row that one thread of a CPU does: to begin a thread costs as much as a pixel on which nothing lies."""


def by_warps(device: wp.Device, width: int) -> bool:
    """Whether frames of this width are worked on by warps on ``device``."""
    return bool(device.is_cuda and width % 4 == 0)


def row_parts(device: wp.Device, width: int) -> tuple[int, int]:
    """Threads that a row of ``width`` pixels takes, and how many pixels each does where they are not warps."""
    if by_warps(device, width):
        return WARP_LANES * -(-width // WARP_PIXELS), 0
    run = CPU_RUN if device.is_cpu else 1
    return -(-width // run), run


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned int words[32][96];
    unsigned int* own = words[threadIdx.x / 32];
    const int lane = threadIdx.x & 31, first = column / 4 * 3, count = frame.shape[1] / 4 * 3;
    const unsigned int* line = reinterpret_cast<const unsigned int*>(frame.data) + size_t(row) * count;
    for (int k = lane; k < 96; k += 32)
        if (first + k < count) own[k] = line[first + k];
    __syncwarp();
    return reinterpret_cast<wp::uint64>(own);
#else
    return 0;
#endif
""")
def load_codes(frame: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32) -> wp.uint64:
    """Load the warp's pixels of a row from a column on; where they are, for the functions below. For a whole warp."""


@wp.func_native("""
    const unsigned char* at = reinterpret_cast<const unsigned char*>(codes) + 3 * pixel;
    return wp::vec_t<3, wp::uint8>(at[0], at[1], at[2]);
""")
def get_code(codes: wp.uint64, pixel: wp.int32) -> wp.vec3ub:
    """One of the warp's pixels; another lane must not set it meanwhile."""


@wp.func_native("""
    unsigned char* at = reinterpret_cast<unsigned char*>(codes) + 3 * pixel;
    for (int k = 0; k < 3; ++k) at[k] = code[k];
""")
def set_code(codes: wp.uint64, pixel: wp.int32, code: wp.vec3ub):
    """Change one of the warp's pixels."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int* own = reinterpret_cast<const unsigned int*>(codes);
    const int lane = threadIdx.x & 31, first = column / 4 * 3, count = picture.shape[1] / 4 * 3;
    unsigned int* line = reinterpret_cast<unsigned int*>(picture.data) + size_t(row) * count;
    __syncwarp();
    for (int k = lane; k < 96; k += 32)
        if (first + k < count) line[first + k] = own[k];
    __syncwarp();
#endif
""")
def store_codes(codes: wp.uint64, picture: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32):
    """Store the warp's pixels where they were loaded, in another picture of the same size. For a whole warp."""
