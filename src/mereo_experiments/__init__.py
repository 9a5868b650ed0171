"""Experiments: the paper's tables and figures, and the speed of each stage against roofline and baseline."""
