"""The metric of the paper, truth, test sets, and real scans."""
