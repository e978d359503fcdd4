"""Light of the environment beyond what the ball shows: recovered, captured, measured."""
