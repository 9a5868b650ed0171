"""Pose and state of the statistical model that explain a frame, searched without a network."""
