"""Frames in: image folders, video files, cameras, network streams, generated clips."""
