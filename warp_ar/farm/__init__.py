"""Batch processing of many clips and data sets: jobs, workers and a crash-safe manifest."""
