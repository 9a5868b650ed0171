"""The paper's experiments, and speed against roofline and baseline."""
