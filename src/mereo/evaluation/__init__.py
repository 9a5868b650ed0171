"""Metrics of the paper (IoU, mIoU), ground truth, test sets, and real scans with their registration."""
