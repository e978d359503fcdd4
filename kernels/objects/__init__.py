"""Kernels that shade virtual objects."""
