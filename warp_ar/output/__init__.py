"""Outputs: pictures, video, environment files, reports."""
