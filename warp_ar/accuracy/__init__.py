"""Accuracy and its cost: errors, times, the budget that a quality keeps, and the report of both."""
