"""Accuracy and cost of methods: errors, times, reports, and the quality that keeps a time budget."""
