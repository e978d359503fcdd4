"""Sources of frames: image folders, video files, cameras, network streams, generated clips."""
