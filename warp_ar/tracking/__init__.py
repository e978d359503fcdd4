"""Detection of markers and boards, and the camera pose from them."""
