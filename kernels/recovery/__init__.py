"""Kernels that measure the receiver to recover clipped light."""
