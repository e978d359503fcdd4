"""Kernels that shade virtual objects and the mirror ball."""
