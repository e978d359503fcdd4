"""Markers and boards: where they are in a picture, and the pose of the camera."""
