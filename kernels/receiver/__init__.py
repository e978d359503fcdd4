"""Kernels of the real surfaces: virtual light and shadows on them, and the light that they lose."""
