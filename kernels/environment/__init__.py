"""Kernels of the environment: from the ball's pixels to a filtered latlong map."""
