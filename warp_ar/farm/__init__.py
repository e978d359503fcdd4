"""Many clips, and data sets of them: jobs that name files, workers that light them, a manifest that loses nothing."""
