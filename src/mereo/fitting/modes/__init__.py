"""Pose and coefficients of the statistical model that explain a frame, from the states that may have made it."""
