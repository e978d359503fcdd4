"""Outputs: pictures, video, environment files, exchange files and reports."""
