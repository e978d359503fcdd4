"""Warp kernels, one file per stage, each with its launcher.

Import them as ``warp_ar.kernels.<module>``. Public launchers write into arrays that the caller owns; they never
allocate, synchronise or read back, so they can be captured in a CUDA graph.
"""
