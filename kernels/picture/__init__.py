"""Kernels of the picture: codes and radiance, visibility, composite, exposure."""
