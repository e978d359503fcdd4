"""What accuracy costs: errors, times, the budget that a quality keeps, and the report of both."""
