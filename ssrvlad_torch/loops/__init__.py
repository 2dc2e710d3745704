"""Loop closures: online detection in a live stream, for SLAM."""
