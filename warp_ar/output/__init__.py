"""Where results go: pictures, video, environment files, reports."""
