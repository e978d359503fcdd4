"""Calibration of camera, lens and response curve, and the printed card."""
