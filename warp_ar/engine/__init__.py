"""From a request to lit frames: graph, scheduler, pipeline, transfers."""
